"""Evaluation of slip detectors: labelled trials, scoring, training."""

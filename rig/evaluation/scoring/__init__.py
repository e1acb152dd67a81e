"""Scores of detectors: outcomes of labelled trials, rates with intervals, baselines, ROC."""

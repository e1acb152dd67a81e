"""Trials for the scoring of detectors that are made on the whole simulated bench, over the
instruments' own protocols: what is drawn, how it is made, and what is read from its run file."""

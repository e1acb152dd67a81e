"""Processed files: the results of a detector, beside the run file that they came from."""

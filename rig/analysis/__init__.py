"""What runs mean: fits, curves, summaries and scores; no I/O."""

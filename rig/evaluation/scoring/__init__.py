"""How good a detector is: outcomes of labelled trials, tables with confidence, baselines, ROC."""

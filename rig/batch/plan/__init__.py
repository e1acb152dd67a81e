"""Planning a batch: the batch file read, expanded into runs, validated and estimated."""

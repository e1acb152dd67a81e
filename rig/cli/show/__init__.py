"""What `rig show` prints: a file in brief and in full, its results, values in words."""

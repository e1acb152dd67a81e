"""Processing of finished run files: slip detection, one file or many in parallel."""

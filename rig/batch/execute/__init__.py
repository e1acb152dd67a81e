"""Executing a batch: supervisor, worker, crash recovery, drift checks, post-processing."""

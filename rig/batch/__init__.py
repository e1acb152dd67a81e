"""Batches: many runs in one night, each exactly once."""

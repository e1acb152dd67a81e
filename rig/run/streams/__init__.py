"""Streams of samples: their reader threads, and the force monitor, which acts by itself."""

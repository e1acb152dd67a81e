"""Physics of the bench: pure functions and settings, no I/O."""

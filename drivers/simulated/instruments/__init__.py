"""Simulated instruments: protocol cores without I/O, one module a model."""

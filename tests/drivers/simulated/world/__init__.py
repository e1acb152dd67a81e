"""Tests of the World behind the simulated instruments."""

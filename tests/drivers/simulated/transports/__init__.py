"""Tests of the servers that put simulated instruments on a wire."""

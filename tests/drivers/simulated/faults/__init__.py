"""Tests of the faults that a plan orders, on the wire and on the disk."""

"""Faults of the simulated bench: what goes wrong, on the wire, in the World and on the disk."""

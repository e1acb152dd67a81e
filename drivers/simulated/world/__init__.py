"""The simulated physics of the bench: one World, its axes, contact and ground truth."""

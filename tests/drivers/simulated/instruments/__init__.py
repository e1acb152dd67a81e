"""Tests of the simulated instruments, each over ideal physics instead of a World."""

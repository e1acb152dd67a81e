"""Tests of the simulated bench as a process: its files, its options, its control socket."""

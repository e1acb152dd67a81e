"""Physical models of the bench, for simulation and design: pure functions, settings and state in
arrays. No input or output."""

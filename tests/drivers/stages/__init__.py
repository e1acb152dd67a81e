"""The three stage drivers, each over its simulated stage, and what their tests have in common."""

"""Analysis of trials under force: friction, touch-down, clock offset, axis offset and load rate."""

"""Analysis of trials under force: friction, touch-down, clock offset, axis offset, load rate."""

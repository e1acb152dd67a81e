"""One program at a time on an instrument: locks, who holds them, and the marks left on a bench."""

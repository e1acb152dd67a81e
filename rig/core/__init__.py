"""The base of all other packages: settings, units, errors, the clock, the disk cache."""

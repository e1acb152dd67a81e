"""What everything stands on: settings, units, errors, the clock, the disk cache."""

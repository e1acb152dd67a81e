"""Analysis of measured signals: responses of films, trials under force, calibrations. Arrays in,
numbers out."""

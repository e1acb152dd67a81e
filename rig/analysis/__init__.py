"""What measured signals mean: responses of films, trials under force, calibrations. Arrays in,
numbers out."""

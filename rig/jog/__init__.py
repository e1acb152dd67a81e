"""Moving an axis by hand from the keys of a terminal."""

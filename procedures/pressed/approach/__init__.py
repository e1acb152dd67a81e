"""The ways of z to the pressed object and away from it: their speed, and what watches them."""

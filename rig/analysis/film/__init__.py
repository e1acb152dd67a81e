"""Analysis of a film's response: model, fit, notches, slope, linearity, circuit and gain curve."""

"""Analysis of a film's response: fits, circuit model, drops, slope, linearity, the gain curve."""

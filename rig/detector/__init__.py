"""The detector of incipient slip and what it is made of: arrays in, arrays out, no I/O.

The same code runs while a trial is under way and on a file years later.
"""

DEFAULT_DETECTOR = "paper-hp"
"""The name of the detector that is used where none is given (decision 0059)."""

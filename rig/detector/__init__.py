"""The detector of incipient slip and its parts: arrays in, arrays out, no input or output.

The same code runs during a trial and, years later, on its file.
"""

DEFAULT_DETECTOR = "paper-hp"
"""Name of the detector that is used where none is given. Decision 0059 says why it is not `rig`."""

"""The detector of incipient slip and what it is made of: arrays in, arrays out, no I/O.

The same code runs while a trial is under way and on a file years later.
"""

"""Recordings from elsewhere: text, LVM and MATLAB files, read into a run file of our own.

Nothing is guessed in silence. What a file does not say has to be told, what it says is checked
against what was told, and what is no number is refused with its line. Readers take bytes and give
arrays; only ``importing`` writes.
"""

"""Recordings of other programs: text, LVM and MATLAB files, made into run files.

Nothing is guessed in silence. What a file does not say, the user has to state; what it says is
checked against what the user stated; a cell that is not a number is refused with its line. Readers
take bytes and return arrays; only ``import_file`` writes.
"""

"""Tests of the rooms below use the recorded runs of this folder, which pytest searches for modules
because it has this file."""

"""Tests of the simulated bench, and the ideal physics that tests of single instruments use."""

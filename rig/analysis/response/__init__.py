"""Measured frequency response: sine fits, complex gain, frequency plan, load levelling."""

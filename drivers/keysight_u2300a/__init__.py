"""Keysight U2300A data acquisition units, SCPI over USBTMC."""

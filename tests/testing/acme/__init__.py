"""Instruments that do not exist, with drivers and simulators as another package brings them."""

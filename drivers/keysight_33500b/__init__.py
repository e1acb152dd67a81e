"""Keysight 33500B waveform generators, SCPI over LAN or USB."""

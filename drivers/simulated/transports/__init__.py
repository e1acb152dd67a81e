"""Transports of simulated instruments: HiSLIP, SCPI, Modbus, serial lines, TCP."""

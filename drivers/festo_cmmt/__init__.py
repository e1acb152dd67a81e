"""Festo CMMT-AS and CMMT-ST servo drives, over Modbus TCP."""

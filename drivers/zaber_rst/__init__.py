"""Zaber X-RST rotary stages, in Zaber ASCII."""

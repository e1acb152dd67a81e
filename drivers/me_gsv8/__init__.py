"""ME-Messsysteme GSV-8 measuring amplifier, over a serial line."""

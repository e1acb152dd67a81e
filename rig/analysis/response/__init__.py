"""Measured frequency responses: sine fits, complex response, levelling of the load, response
curves."""

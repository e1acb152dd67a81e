"""The roles that instruments play, the values that pass between them, and calibration records.

Drivers import this package and ``rig.core``, and nothing else of ``rig``.
"""

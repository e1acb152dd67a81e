"""Contact and friction between the condensed skin and a rigid object.

``settings`` describes objects and constants, ``stepper`` advances a contact in time, and ``truth``
records which ridge slipped when. ``kernel`` is the compiled step; it is imported on first use only.
"""

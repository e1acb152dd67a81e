"""Contact and friction between the condensed skin and a rigid object.

``settings`` names objects and constants, ``stepper`` advances a contact in time, ``truth`` says
who slipped when. ``kernel`` is the compiled step; it is imported on first use only.
"""

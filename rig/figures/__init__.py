"""Figures of run files: the only importer of matplotlib, and only inside a call.

Which figures a file gets is declared by entry points (`rig.figures.registry`);
`rig.figures.drawing` draws them. Every figure of data from a simulated bench is marked as
simulated.
"""

"""Interlock contacts: they are watched during a run; latches and proof tests outlive it."""

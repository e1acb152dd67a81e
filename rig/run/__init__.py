"""Runs procedures: points, arming, the stop flag, the guard; safe first, data second."""

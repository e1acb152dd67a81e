"""Runs procedures: points, arming, stop requests, the guard. The bench is made safe first, data are
saved second."""

"""When z is clear of what it presses, and when something is still pressed.

The run, its guard and whatever shows the bench go by the same values.
"""

from __future__ import annotations

CLEAR_mm = 0.3
"""Distance in mm above the earliest contact at which z is clear of it."""
PRESSED_N = 0.4
"""Mean force in N above which something is pressed: far above the sensor's noise and its drift
within a run."""

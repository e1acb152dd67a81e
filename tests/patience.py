"""How long a driver's test lets an instrument be silent, on the wall clock."""

from __future__ import annotations

import os

TIMEOUT_S = float(os.environ.get("RIG_TEST_TIMEOUT_S", "0.3"))
"""Time-out of links that a test disturbs. Short, because a test of silence waits for all of it and
charges it to the bench's clock, on which drives have time-outs of their own."""
UNDISTURBED_S = 10.0
"""Time-out of links that nothing disturbs: a busy computer never meets it."""

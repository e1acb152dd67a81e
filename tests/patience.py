"""How long a driver's test lets an instrument be silent, on the wall clock."""

from __future__ import annotations

import os

TIMEOUT_S = float(os.environ.get("RIG_TEST_TIMEOUT_S", "1.0"))
"""Time-out of links that a test disturbs. A test of silence waits for all of it and charges it to
the bench's clock, on which drives have time-outs of their own; a shorter one is met by a busy
computer, too."""
UNDISTURBED_S = 10.0
"""Time-out of links that nothing disturbs: a busy computer never meets it."""

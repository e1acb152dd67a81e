"""JSON for other programs, which has neither NaN nor infinities: null stands for them.

The files of this program that keep them apart have a form of their own
(`rig.files.journal.format`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any


def json_text(value: Any) -> str:
    """Return a nested value as JSON on one line; a path, a date or the like is its text."""
    return json.dumps(finite(value), allow_nan=False, default=str)


def finite(value: Any) -> Any:
    """Return a nested value with None for every number that is not finite."""
    if isinstance(value, Integral):  # NumPy's as well
        return value if isinstance(value, bool) else int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value

"""What other programs read is JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from rig.core.json_text import json_text


def refused(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


@pytest.mark.parametrize(
    ("value", "read"),
    [
        ({"worst_V": math.nan, "inf_V": [math.inf, -math.inf, 1.5]}, None),
        ({"worst_V": np.float64("nan"), "inf_V": (math.inf, math.nan, 1.5)}, None),
        (MappingProxyType({"worst_V": None, "inf_V": (None, None, np.float64(1.5))}), None),
        ({"n": np.int64(3), "m": np.float32(0.5)}, {"n": 3, "m": 0.5}),
        ({"file": Path("a.h5"), "n": 3, "safe": True}, {"file": "a.h5", "n": 3, "safe": True}),
    ],
)
def test_a_number_that_is_not_finite_is_null(value: Any, read: Any) -> None:
    expected = read or {"worst_V": None, "inf_V": [None, None, 1.5]}
    assert json.loads(json_text(value), parse_constant=refused) == expected

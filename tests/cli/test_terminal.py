"""Keys out of a terminal's bytes, whole, in parts, or unknown."""

from __future__ import annotations

import pytest

from rig.cli.terminal import ESCAPE_S, Keyboard, in_a_line
from rig.jog.keys import AxisPosition, JogAxis, Key
from rig.jog.session import JogStatus


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", [Key.LESS, Key.MORE, Key.MORE, Key.LESS]),
        (b"\x1bOA\x1bOB", [Key.LESS, Key.MORE]),
        (b"-+=", [Key.LESS, Key.MORE, Key.MORE]),
        (b"\thyq", [Key.NEXT_AXIS, Key.HOME, Key.CONFIRM, Key.LEAVE]),
        (b" ", [Key.STOP]),
        (b"x\x13\x1b[5~\x1b[1;5C\x1bx", [Key.STOP] * 5),  # Ctrl-S, page up, Ctrl-right, Alt-x
        ("ä".encode(), [Key.STOP] * 2),
        (b"\x1b\x1b[A", [Key.LEAVE, Key.LESS]),
    ],
)
def test_bytes_mean_keys(typed: bytes, keys: list[Key]) -> None:
    assert Keyboard().feed(typed, 0.0) == keys


def test_a_sequence_may_come_in_parts() -> None:
    keyboard = Keyboard()
    assert keyboard.feed(b"\x1b", 0.0) == []
    assert keyboard.feed(b"[", 0.01) == []
    assert keyboard.feed(b"A", 0.02) == [Key.LESS]


def test_an_escape_alone_is_the_key_and_a_sequence_that_never_ends_stops() -> None:
    keyboard = Keyboard()
    assert keyboard.feed(b"\x1b", 0.0) == []
    assert keyboard.feed(b"", ESCAPE_S) == [Key.LEAVE]
    assert keyboard.feed(b"\x1b[", 1.0) == []
    assert keyboard.feed(b"", 1.0 + ESCAPE_S) == [Key.STOP]


def test_eighty_columns_hold_the_chosen_axis_and_the_force() -> None:
    axes = tuple(JogAxis(name, "mm", 0, 40, 0.1, 1.0) for name in ("stage_z", "stage_x", "rotary"))
    places = {axis.name: AxisPosition(-12.3456, False) for axis in axes}
    line = in_a_line(JogStatus(axes, places, axes[2], axes[2], (-10.0, -10.0, -10.0), True))
    force = "force x -10.00 y -10.00 z -10.00 N OVER THE LIMIT (not tared)"
    assert line[:79].startswith(
        "rotary -12.346 mm (not homed) moving | force x -10.00 y -10.00 z -10.00"
    )
    assert line.endswith(
        f"{force} | stage_z -12.346 mm (not homed) | stage_x -12.346 mm (not homed)"
    )

"""What a trial records of the axes that its force sensor lacks: no numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from procedures.pressed.approach.tare import ForceZero
from procedures.pressed.record.force import TrialForce
from rig.instruments.roles import ForceFrames


def recorded(axes: str) -> dict[str, Any]:
    """The rows of the streams after four frames of a sensor with these axes."""
    values = np.zeros((4, 3))
    values[:, ["xyz".index(axis) for axis in axes]] = 2.0
    frames = ForceFrames(0, values.astype(np.float32), values, np.zeros(4, bool), "gf")
    rows: dict[str, Any] = {}
    force = SimpleNamespace(axes=axes, frames_seen=0, frames_since=lambda first: frames)

    def record_rows(name: str, first: int, values: Any, rate_S_s: float, units: str) -> None:
        rows[name] = values

    clock = SimpleNamespace(now=lambda: 0.0)
    streams = SimpleNamespace(record_rows=record_rows)
    run: Any = SimpleNamespace(force=force, clock=clock, streams=streams)
    record: Any = SimpleNamespace(force_rate_S_s=1000.0, frames=0, force=[], frame_looks=[])
    trial_force = TrialForce(run, record)
    force.frames_seen = 4
    trial_force.count_frames()
    trial_force.record_frames()
    assert np.array_equal(record.force[0], rows["force"], equal_nan=True)
    return rows


def test_axes_that_the_sensor_lacks_are_no_zeros() -> None:
    rows = recorded("z")
    assert (rows["force"][:, 0] == 2.0).all(), "F_n"
    assert np.isnan(rows["force"][:, 1:]).all(), "F_t and F_y"
    assert np.isnan(rows["bridges"][:, :2]).all()
    assert (rows["bridges"][:, 2] == 2.0).all()


def test_three_axes_are_recorded_as_they_are() -> None:
    rows = recorded("xyz")
    assert (rows["force"] == 2.0).all()
    assert (rows["bridges"] == 2.0).all()


def test_a_zero_has_columns_for_the_axes_that_there_are() -> None:
    zero = ForceZero(0.0, 0.0, 1.5)
    assert zero.columns("z") == {
        "force_zero_x_N": None,
        "force_zero_y_N": None,
        "force_zero_z_N": 1.5,
    }
    assert zero.columns("xyz")["force_zero_x_N"] == 0.0

"""What ends an approach in which the force sensor does not show what z does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from procedures.pressed.approach.approach_watch import ApproachWatch, naming_the_sensor
from procedures.pressed.approach.torque_watch import TorqueWatch
from rig.core.errors import InstrumentError, InstrumentTimeoutError

CONTACT_N, TARGET_N = 0.1, 4.0
TICK_S, SPEED_mm_s = 0.01, 0.5


class Bench:
    """Clock, z stage and force sensor: the force is noise plus a spring below `contact_mm`."""

    def __init__(self, noise_N: float, contact_mm: float, stiffness_N_mm: float = 100.0):
        self.noise_N, self.noise = np.full(3, noise_N), np.random.default_rng(1)
        self.contact_mm, self.stiffness_N_mm = contact_mm, stiffness_N_mm
        self.now_s, self.mm, self.stopped = 0.0, 12.2, False
        fixture = SimpleNamespace(parked_mm=5.0, contact_from_mm=12.0, contact_to_mm=13.0)
        described = SimpleNamespace(stage_z=self, settings=SimpleNamespace(fixture=fixture))
        self.run = SimpleNamespace(bench=described, clock=self, force=self)

    def now(self) -> float:
        return self.now_s

    def position_mm(self) -> float:
        return self.mm

    def stop(self) -> None:
        self.stopped = True

    def latest_N(self, seconds: float) -> np.ndarray:  # noqa: N802 - the unit keeps its capital
        pressed_N = max(0.0, self.mm - self.contact_mm) * self.stiffness_N_mm
        along_z = pressed_N + self.noise_N[2] * self.noise.standard_normal(round(1e3 * seconds))
        return np.column_stack([0 * along_z, 0 * along_z, along_z])

    def mean_N(self, seconds: float) -> np.ndarray:  # noqa: N802
        mean: np.ndarray = self.latest_N(seconds).mean(axis=0)
        return mean

    def go(self, watch: ApproachWatch, way_mm: float, moves: bool, touched: bool) -> None:
        for _ in range(round(way_mm / SPEED_mm_s / TICK_S)):
            watch.step(self.mm, float(self.mean_N(0.004)[2]), touched)
            watch.commanded(0.015, SPEED_mm_s)
            self.now_s += TICK_S
            self.mm += SPEED_mm_s * TICK_S if moves else 0.0


def watch_of(bench: Bench) -> ApproachWatch:
    torque = TorqueWatch(bench.run)  # type: ignore[arg-type]
    return ApproachWatch(bench.run, CONTACT_N, TARGET_N, torque)  # type: ignore[arg-type]


@pytest.mark.parametrize("noise_N", [0.002, 0.3])
def test_a_contact_that_is_only_noise_is_refused(noise_N: float) -> None:
    bench = Bench(noise_N, contact_mm=20.0)
    with pytest.raises(InstrumentError, match=r"felt at 12\.200 mm.* the force has not changed"):
        bench.go(watch_of(bench), 0.5, moves=True, touched=True)
    assert bench.stopped
    assert bench.mm < 12.3


@pytest.mark.parametrize("noise_N", [0.002, 0.3])
def test_a_contact_that_is_real_is_confirmed_in_noise(noise_N: float) -> None:
    bench = Bench(noise_N, contact_mm=12.2, stiffness_N_mm=30.0)
    bench.go(watch_of(bench), 0.5, moves=True, touched=True)
    assert not bench.stopped


def test_a_sensor_whose_sign_is_wrong_is_named_before_its_force_is_large() -> None:
    """It shows a pull where z presses: no contact is ever felt."""
    bench = Bench(0.002, contact_mm=12.3, stiffness_N_mm=-145.0)
    with pytest.raises(InstrumentError, match="as if something pulled") as caught:
        bench.go(watch_of(bench), 0.6, moves=True, touched=False)
    assert caught.value.device == "force_sensor"
    assert "correct the sign of z in [force_sensor]" in str(caught.value.hint)
    assert bench.stopped
    assert (bench.mm - bench.contact_mm) * 145.0 < 5.0


def test_a_pull_of_a_moment_is_no_wrong_sign(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(0.002, contact_mm=20.0)
    quiet = bench.latest_N

    def pulled(seconds: float) -> np.ndarray:
        force = quiet(seconds)
        force[-20:, 2] -= 5.0  # N, for 20 ms
        return force

    monkeypatch.setattr(bench, "latest_N", pulled)
    bench.go(watch_of(bench), 0.05, moves=True, touched=False)
    assert not bench.stopped


def test_a_stage_that_is_held_without_a_force_makes_the_sensor_suspect() -> None:
    bench = Bench(0.002, contact_mm=20.0)
    with pytest.raises(InstrumentError, match="stage_z is held at 12") as caught:
        bench.go(watch_of(bench), 0.5, moves=False, touched=False)
    assert caught.value.device == "force_sensor"
    assert "suspect the force sensor" in str(caught.value.hint)
    assert bench.now_s < 0.4


def test_a_stage_that_is_held_above_any_contact_is_not_the_sensors_fault() -> None:
    bench = Bench(0.002, contact_mm=20.0)
    bench.mm = 11.8
    with pytest.raises(InstrumentError, match="stage_z is held at 11") as caught:
        bench.go(watch_of(bench), 0.5, moves=False, touched=False)
    assert caught.value.device == "stage_z"


def test_a_program_that_stands_still_for_seconds_has_not_been_held() -> None:
    bench = Bench(0.002, contact_mm=20.0)
    watch = watch_of(bench)
    bench.go(watch, 0.1, moves=True, touched=False)
    bench.now_s += 3.0
    bench.mm += 0.015
    bench.go(watch, 0.1, moves=True, touched=False)
    assert not bench.stopped


@pytest.mark.parametrize(("mm", "suspected"), [(12.5, True), (11.8, False)])
def test_a_stage_that_fails_without_a_force_in_the_contact_range_makes_the_sensor_suspect(
    mm: float, suspected: bool
) -> None:
    bench = Bench(0.002, contact_mm=20.0)
    bench.mm = mm
    naming = naming_the_sensor(bench.run, CONTACT_N)  # type: ignore[arg-type]
    with pytest.raises(InstrumentError, match="torque limit") as caught, naming:
        raise InstrumentError("stage_z", "move", "stopped by its torque limit", "look")
    assert ("suspect the force sensor" in str(caught.value.hint)) == suspected
    assert "look" in str(caught.value.hint)


def test_a_stage_that_fails_while_it_presses_says_what_the_sensor_reads() -> None:
    """A sensor that reads a tenth lets z press up to its torque limit: its reading shows that."""
    bench = Bench(0.002, contact_mm=12.4, stiffness_N_mm=9.0)
    bench.mm = 12.9
    naming = naming_the_sensor(bench.run, CONTACT_N)  # type: ignore[arg-type]
    with (
        pytest.raises(InstrumentError, match=r"limit; force_sensor reads 4\.5 N") as caught,
        naming,
    ):
        raise InstrumentError("stage_z", "move", "stopped by its torque limit", "look")
    assert caught.value.hint == "look"


def test_a_stage_whose_link_is_silent_does_not_make_the_sensor_suspect() -> None:
    """And it stays known as silent, so that making safe does not wait for it first."""
    bench = Bench(0.002, contact_mm=20.0)
    bench.mm = 12.5
    silent = InstrumentTimeoutError("stage_z", "read register 100", "no answer", "look")
    naming = naming_the_sensor(bench.run, CONTACT_N)  # type: ignore[arg-type]
    with pytest.raises(InstrumentTimeoutError) as caught, naming:
        raise silent
    assert caught.value is silent

"""The World's own watch: which force and which motion it finds fault with."""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from drivers.simulated.ports import Exchange
from drivers.simulated.world.monitor import Monitor, WatchedLine, WatchSettings

LIMIT = WatchSettings(force_limit_N=10.0, reaction_s=0.010, longest_over_s=0.2)


class Line:
    """A serial instrument that has something to say."""

    def __init__(self, sent: bytes):
        self.sent = sent

    def exchanges(self, data: bytes, by: str) -> list[Exchange]:
        return []

    def frames_until(self, now_us: int) -> bytes:
        return self.sent


def reports(force: npt.NDArray[np.float64], every: int = 7) -> list[tuple[str, object]]:
    """What is reported of a force along y, N at each millisecond, looked at now and then."""
    reported: list[tuple[str, object]] = []

    def force_N(times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # noqa: N802
        at = np.rint(times_s * 1e3).astype(int)
        return np.stack([0 * at, force[at], 0 * at], axis=1)

    monitor = Monitor(
        LIMIT, force_N, lambda: (), lambda what, value: reported.append((what, value))
    )
    for now_ms in range(0, len(force), every):
        monitor.check(1000 * now_ms)
    return reported


def violations(force: npt.NDArray[np.float64], every: int = 7) -> list[tuple[str, object]]:
    """What it finds fault with in such a force."""
    return [report for report in reports(force, every) if report[0] == "violation"]


def test_when_something_is_pressed_and_no_more_is_written_down_to_the_millisecond() -> None:
    force = np.concatenate([np.zeros(20), np.full(30, 3.0), np.zeros(20), np.full(20, -3.0)])
    expected = [("pressed", 20), ("released", 50), ("pressed", 70)]
    for every in (1, 7, 100):
        reported = reports(np.append(force, np.full(110, -3.0)), every)
        assert reported == [(what, {"at_us": 1000 * ms}) for what, ms in expected]


def rising(rate_N_ms: float, from_N: float, for_ms: int, then_ms: int = 100) -> list[float]:
    """A ramp, and where it ends, held."""
    ramp = [from_N + rate_N_ms * step for step in range(for_ms)]
    return ramp + [ramp[-1]] * then_ms


def test_a_force_that_stops_rising_in_time_is_none() -> None:
    assert violations(np.array(rising(0.5, 0.0, 29))) == [], "10 N after 20 ms, 14 N after 28"


def test_a_force_that_keeps_rising_is_one_violation_reported_once() -> None:
    ((what, reported),) = violations(np.array(rising(0.5, 0.0, 40)))
    assert what == "violation"
    assert "5.5 N over its limit, which it rose by 5 N at most in 0.01 s" in str(reported)


def test_it_does_not_matter_when_it_is_looked_at_nor_which_way_the_force_points() -> None:
    force = np.array(rising(0.5, 0.0, 40))
    for every in (1, 3, 50):
        assert len(violations(-force, every)) == 1
        assert violations(-0.9 * force[:30], every) == []


def test_a_second_time_over_the_limit_is_another_one() -> None:
    over = rising(0.5, 0.0, 40)
    assert len(violations(np.array(over + [0.0] * 50 + over))) == 2


def test_a_force_that_has_stopped_rising_and_stays_over_the_limit_is_a_violation_once() -> None:
    plateau = rising(0.5, 0.0, 29, then_ms=190)
    assert violations(np.array(plateau)) == [], "over the limit from 21 to 218 ms"
    below_again = [0.0] * 7
    assert violations(np.array(plateau + below_again + plateau)) == []
    for every in (1, 7, 50):
        ((what, reported),) = violations(np.array(rising(0.5, 0.0, 29, then_ms=400)), every)
        assert (what, reported) == (
            "violation",
            "force of 14 N, over its limit for more than 0.2 s",
        )


def test_what_moves_at_the_end_is_reported() -> None:
    reported: list[object] = []
    monitor = Monitor(
        LIMIT,
        lambda times_s: np.zeros((len(times_s), 3)),
        lambda: ("stage_x moves at 3 mm/s",),
        lambda what, value: reported.append((what, value)),
    )
    monitor.over()
    assert reported == [
        ("violation", "stage_x moves at 3 mm/s although no run is active"),
        ("largest-force", 0.0),
        ("last-force", 0.0),
        ("longest-over-limit", 0.0),
    ]


def test_frames_of_three_floats_are_written_down_with_and_without_a_check() -> None:
    values = [np.array([k, k, k], ">f4").tobytes() for k in (1, 2)]
    plain = b"".join(b"\xaa\x12\xb0" + data + b"\x85" for data in values)
    checked = b"".join(b"\xaa\x32\xb0" + data + b"\x12\x34\x85" for data in values)

    for sent, written_down in ((plain, values), (checked, values), (b"", None)):
        reported: list[object] = []
        line = WatchedLine(Line(sent), lambda what, value: reported.append(value))  # noqa: B023
        assert line.frames_until(0) == sent
        expected = [] if written_down is None else [[zlib.crc32(data) for data in written_down]]
        assert reported == expected

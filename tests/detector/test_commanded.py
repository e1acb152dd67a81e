"""What the bench knows as an input of detectors: moves of x, which the detector `impulse` uses,
held forces, and rows that the DAQ has cut off."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from rig.core.settings import Settings
from rig.detector.contract import Detector
from rig.detector.detector import IncipientSlipDetector, NETWORK_RATE_Hz
from rig.detector.events import SlipEvent
from rig.detector.notices import (
    CutOff,
    HeldForce,
    XMove,
    columns_of,
    from_text,
    notices_in,
    to_text,
)
from rig.detector.registered import ChosenDetector, chosen_detector
from rig.detector.resampling import ResampledDetector
from rig.detector.settings import ImpulseSettings, named_detectors

RATE_Hz = 1000.0
STOP = 1500
"""Row at which x stops."""


class Listener(Detector):
    """Notes where the commanded motion changed."""

    version = "1"
    fastest_Hz = 1000.0

    def reset(self) -> None:
        self.changes: list[tuple[int, float, float]] = []

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        return []

    def commanded(self, before_mm_s: float, after_mm_s: float) -> None:
        self.changes.append((self.rows, before_mm_s, after_mm_s))


def listened(*moves: XMove, rows: int = 1000, block: int = 1000) -> list[tuple[int, float, float]]:
    """What a detector hears that is given these moves and then rows, in blocks."""
    detector = Listener(Settings(), RATE_Hz)
    for move in moves:
        detector.notice(move)
    for first in range(0, rows, block):
        detector.add(np.zeros((min(block, rows - first), 2)), first_sample=first)
    return detector.changes


def held(press_mV: float, gap_mV: float, seed: int = 0) -> np.ndarray:
    """Volts (2000, 2): a press whose peak is `press_mV` (4.5 for 4 N), a shear from 1.2 s on that
    ends at `STOP` as quickly as a stop of x ends it, and by `gap_mV` more for 3 ms."""
    time = np.arange(2000) / RATE_Hz
    press = np.where((time > 0.3) & (time < 0.6), -np.sin(np.pi * (time - 0.3) / 0.3), 0.0)
    press *= press_mV
    level = 12.0 * np.clip((time - 1.2) / 0.05, 0, 1) * np.clip((1.503 - time) / 0.003, 0, 1)
    v_d = 0.1 * press + level - gap_mV * np.exp(-(((time - 1.503) / 0.0015) ** 2))
    noise = 0.05 * np.random.default_rng(seed).standard_normal((2000, 2))
    return 1e-3 * (np.column_stack([press + v_d / 2, press - v_d / 2]) + noise)


def slips(
    volts: np.ndarray, *moves: XMove, settings: ImpulseSettings | None = None, block: int = 5000
) -> list[int]:
    detector = IncipientSlipDetector(settings or ImpulseSettings(), RATE_Hz)
    for move in moves:
        detector.notice(move)
    events: list[SlipEvent] = []
    for first in range(0, len(volts), block):
        events += detector.add(volts[first : first + block], first_sample=first)
    events += detector.finish()
    return [event.sample for event in events if event.kind == "incipient slip"]


# --- the commands --------------------------------------------------------------------------------


def test_a_move_begins_at_its_row_and_ends_where_it_comes_to_its_target():
    assert listened(XMove(100, -0.5, 300)) == [(100, 0.0, -0.5), (300, -0.5, 0.0)]


def test_a_further_move_takes_the_place_of_what_was_to_come():
    moves = XMove(100, 0.5, 300), XMove(200, -0.5, 400), XMove(350, 0.0, 350)
    expected = [(100, 0.0, 0.5), (200, 0.5, -0.5), (350, -0.5, 0.0)]
    assert listened(*moves) == expected
    assert listened(*moves, block=7) == expected


def test_a_move_that_comes_late_begins_with_the_next_row():
    detector = Listener(Settings(), RATE_Hz)
    detector.add(np.zeros((250, 2)))
    detector.notice(XMove(100, 0.5, 200))
    detector.add(np.zeros((250, 2)))
    assert detector.changes == [(250, 0.0, 0.5), (251, 0.5, 0.0)]


def test_after_missing_rows_the_speed_is_still_known_and_what_was_due_meanwhile_is_done():
    detector = Listener(Settings(), RATE_Hz)
    detector.notice(XMove(100, 0.5, 900))
    heard = []
    for first in (0, 300, 1000):  # from 250 to 300 and from 350 to 1000 rows are missing
        detector.add(np.zeros((50, 2) if first else (250, 2)), first_sample=first)
        heard.append(detector.changes)
    assert heard == [[(100, 0.0, 0.5)], [(300, 0.5, 0.5)], [(1000, 0.5, 0.5), (1000, 0.5, 0.0)]]


def test_without_a_command_missing_rows_make_none():
    detector = Listener(Settings(), RATE_Hz)
    detector.add(np.zeros((250, 2)), first_sample=0)
    detector.add(np.zeros((50, 2)), first_sample=300)
    assert detector.changes == []


def test_the_network_sees_the_speed_of_x_after_missing_rows():
    rig = IncipientSlipDetector(named_detectors()["rig"], NETWORK_RATE_Hz)
    rig.notice(HeldForce(50, 4.0))
    rig.notice(XMove(100, 0.5, 90_000))
    rig.add(np.zeros((2000, 2)), first_sample=0)
    rig.add(np.zeros((200, 2)), first_sample=2400)
    state = rig._state[0]
    assert (state["x_known"], state["x_speed"], state["force_known"]) == (1, 0.5, 1)
    assert (state["x_started"], state["x_braked"]) == (0.0, 0.0), "it goes as it went"


def test_a_move_goes_through_a_check_and_to_the_rows_of_another_rate(
    monkeypatch: pytest.MonkeyPatch,
):
    resampled = ResampledDetector(Listener, Settings(), 10 * RATE_Hz)
    resampled.notice(XMove(1000, 0.5, 3000))
    resampled.add(np.zeros((5000, 2)))
    inner: Any = resampled._inner
    assert inner.changes == [(100, 0.0, 0.5), (300, 0.5, 0.0)]
    monkeypatch.setattr(ChosenDetector, "kind", Listener)
    checked: Any = ChosenDetector("lab-listener", Settings()).make(RATE_Hz)
    checked.notice(XMove(100, 0.5, 300))
    checked.add(np.zeros((500, 2)))
    assert checked._inner.changes == [(100, 0.0, 0.5), (300, 0.5, 0.0)]


def test_notices_survive_as_text_and_as_columns_and_older_files_have_moves_or_none():
    moves = [XMove(100, -0.5, 300), XMove(200, 0.25, 260)]
    notices = [*moves, HeldForce(150, 3.6), CutOff(180, 190)]
    assert from_text(to_text(notices)) == notices
    assert notices_in(columns_of(notices)) == notices
    assert notices_in({"x_moves": "[[100, -0.5, 300]]"}) == [XMove(100, -0.5, 300)]
    assert notices_in({"x_moves": None}) == []
    for nonsense in ("[1, 2]", '[["force", 1]]', '[["x", 1, 2, 3, 4]]', '[["force", 1, "N"]]', "{"):
        with pytest.raises(ValueError, match="not a list of notices"):
            from_text(nonsense)


class ForceListener(Listener):
    """Notes where the normal force that is to be held changed, too."""

    def commanded_force(self, before_N: float | None, after_N: float) -> None:
        self.changes.append((self.rows, -1.0 if before_N is None else before_N, after_N))


@pytest.mark.parametrize("block", [7, 1000])
def test_a_held_force_is_heard_at_its_row_among_the_moves(block: int):
    detector = ForceListener(Settings(), RATE_Hz)
    for one in (HeldForce(90, 4.0), XMove(100, 0.5, 300), HeldForce(200, 3.0), HeldForce(200, 2.5)):
        detector.notice(one)
    for first in range(0, 500, block):
        detector.add(np.zeros((min(block, 500 - first), 2)), first_sample=first)
    expected = [(90, -1.0, 4.0), (100, 0.0, 0.5), (200, 4.0, 2.5), (300, 0.5, 0.0)]
    assert detector.changes == expected


def test_after_missing_rows_the_held_force_is_still_known():
    detector = ForceListener(Settings(), RATE_Hz)
    detector.notice(HeldForce(100, 4.0))
    detector.add(np.zeros((250, 2)), first_sample=0)
    detector.add(np.zeros((50, 2)), first_sample=400)
    assert detector.changes == [(400, 4.0, 4.0)]


def test_a_held_force_goes_to_the_rows_of_another_rate():
    resampled = ResampledDetector(ForceListener, Settings(), 10 * RATE_Hz)
    resampled.notice(HeldForce(1000, 4.0))
    resampled.add(np.zeros((5000, 2)))
    inner: Any = resampled._inner
    assert inner.changes == [(100, -1.0, 4.0)]


@pytest.mark.parametrize("name", ["paper-hp", "paper-literal"])
def test_the_other_detectors_find_the_same_with_commands_as_without(name: str):
    volts, found = held(4.5, 30.0), []
    for moves in ((), (XMove(1200, 0.5, STOP),)):
        detector = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
        for move in moves:
            detector.notice(move)
        found.append(detector.add(volts) + detector.finish())
    assert found[0] == found[1] != []


# --- the detector `impulse` ----------------------------------------------------------------------


def test_a_stop_that_was_commanded_is_no_slip_and_one_that_was_not_is():
    volts = held(4.5, 15.0)
    assert slips(volts, XMove(1200, 0.5, STOP)) == []
    (slip,) = slips(volts, XMove(1200, 0.5, 1900))
    assert 1500 <= slip <= 1508
    assert slips(volts) == [slip], "without commands nothing is known of a stop"


def test_a_slip_is_found_also_where_x_has_just_stopped():
    (slip,) = slips(held(4.5, 30.0), XMove(1200, 0.5, STOP))
    assert 1500 <= slip <= 1506


@pytest.mark.parametrize("then", [0.2, -0.5, 0.0])
def test_x_brakes_where_it_turns_stops_or_loses_more_than_half_of_its_speed(then: float):
    volts = held(4.5, 15.0)
    assert slips(volts, XMove(1200, 0.5, 1900), XMove(STOP, then, 1900)) == []
    assert slips(volts, XMove(1200, 0.5, 1900), XMove(STOP, 0.3, 1900)) != []


def test_the_threshold_follows_the_touch():
    assert slips(held(4.5, 7.0)) == []
    assert len(slips(held(0.25, 7.0))) == 1, "a light touch: 0.2 N"
    level = ImpulseSettings(touch_exponent=0.0)
    assert slips(held(0.25, 7.0), settings=level) == []


def test_a_slip_at_rest_needs_no_motion_that_arms():
    volts = held(4.5, 30.0)
    volts[700:1497] = volts[650:651]  # at rest until the slip
    volts[700:1497] += 5e-5 * np.random.default_rng(1).standard_normal((797, 2))
    found = slips(volts)
    assert found
    assert 1494 <= found[0] <= 1506


def test_nothing_is_found_in_the_touch_down_and_contact_from_the_begin_has_to_arm():
    knocked = held(4.5, 0.0)
    knocked[450, 0] += 0.05
    assert slips(knocked) == []
    in_contact = held(4.5, 30.0)[700:]
    assert [700 + at for at in slips(in_contact)] == slips(held(4.5, 30.0))
    quiet = 5e-5 * np.random.default_rng(2).standard_normal((900, 2))
    quiet[600, 0] += 0.05
    assert slips(quiet) == []


def test_blocks_and_commands_that_come_with_them_give_the_events_of_the_file():
    volts, moves = held(4.5, 15.0), [XMove(1200, 0.5, 1900), XMove(1450, 0.2, 1800)]
    whole = slips(volts, *moves)
    for block, seed in itertools.product((1, 7, 400), range(2)):
        assert slips(volts, *moves, block=block) == whole
        rng = np.random.default_rng(seed)
        detector = IncipientSlipDetector(ImpulseSettings(), RATE_Hz)
        waiting, found, first = list(moves), [], 0
        while first < len(volts):
            end = min(len(volts), first + int(rng.integers(1, 2 * block + 1)))
            while waiting and waiting[0].sample < end:
                detector.notice(waiting.pop(0))
            found += detector.add(volts[first:end], first_sample=first)
            first = end
        assert [one.sample for one in found if one.kind == "incipient slip"] == whole


# --- strips that are cut off by the range of the DAQ ---------------------------------------------


class CutOffListener(Listener):
    """Notes where strips were cut off."""

    def cut_off(self, now: bool) -> None:
        self.changes.append((self.rows, float(not now), float(now)))


@pytest.mark.parametrize("block", [1000, 7])
def test_a_cut_off_that_continues_is_one_however_it_was_noticed(block: int):
    expected = [(100, 0.0, 1.0), (110, 1.0, 0.0), (200, 0.0, 1.0), (201, 1.0, 0.0)]
    whole = (CutOff(100, 110), CutOff(200, 201))
    pieces = (CutOff(100, 102), CutOff(102, 106), CutOff(105, 110), CutOff(200, 200))
    for notices in (whole, pieces):
        detector = CutOffListener(Settings(), RATE_Hz)
        for one in notices:
            detector.notice(one)
        for first in range(0, 1000, block):
            detector.add(np.zeros((min(block, 1000 - first), 2)), first_sample=first)
        assert detector.changes == expected


def test_after_missing_rows_a_detector_knows_whether_a_strip_is_cut_off():
    detector = CutOffListener(Settings(), RATE_Hz)
    detector.notice(CutOff(100, 350))
    heard = []
    for first in (0, 300, 1000):
        detector.add(np.zeros((50, 2) if first else (250, 2)), first_sample=first)
        heard.append(detector.changes)
    assert heard == [[(100, 0.0, 1.0)], [(300, 0.0, 1.0)], [(1000, 0.0, 1.0), (1000, 1.0, 0.0)]]


@pytest.mark.parametrize("rate_Hz", [RATE_Hz, 10 * RATE_Hz])
@pytest.mark.parametrize("name", ["rig", "paper-hp", "paper-literal", "impulse"])
def test_what_was_cut_off_is_not_judged_until_50_ms_later(name: str, rate_Hz: float):
    detector = chosen_detector(name).make(rate_Hz)
    detector.notice(CutOff(round(1.095 * rate_Hz), round(1.105 * rate_Hz)))
    noise = 1e-4 * np.random.default_rng(3).standard_normal((round(1.4 * rate_Hz), 2))
    events = [*detector.add(noise), *detector.finish()]
    reason = "cut off: a strip's voltage left the range of the DAQ"
    judging = [(e.kind, e.reason, e.time_s) for e in events if "judge" in e.kind]
    assert [one[:2] for one in judging] == [("cannot judge", reason), ("judges again", reason)]
    filtered_s = 0.0 if rate_Hz == RATE_Hz else 0.005
    assert judging[0][2] == pytest.approx(1.095, abs=1e-9 + filtered_s)
    assert judging[1][2] == pytest.approx(1.155, abs=1e-9 + filtered_s)

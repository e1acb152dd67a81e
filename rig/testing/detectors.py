"""What every detector of incipient slip has to fulfil, as checks of an installed one."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from rig.detector.events import EVENT_KINDS, SlipEvent
from rig.detector.notices import CutOff, HeldForce, Notice, XMove
from rig.detector.registered import ChosenDetector, chosen_detector
from rig.testing.raising import raising

Reals = NDArray[np.float64]

SIZES = (1, 2, 7, 100, 4096)
"""Numbers of rows in the blocks into which a recording is cut."""
DURATION_S = 3.0
OTHER_RATES_Hz = (500.0, 1024.0, 25_600.0, 50_000.0)
"""Rates of recordings in addition to that of the detector itself."""


def recording(rate_Hz: float, seed: int = 0) -> Reals:
    """Return v_1 and v_2 (n, 2) in V as two strips give them: noise of 0.1 mV, a touch-down, two
    slides that end in an impulse of some 50 mV, and a lift-off."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(DURATION_S * rate_Hz)) / rate_Hz
    volts = 1e-4 * rng.standard_normal((len(t), 2)) + 2e-3
    touch = 0.02 * np.exp(-(((t - 0.5) / 0.03) ** 2))
    lift_off = -0.02 * np.exp(-(((t - 2.8) / 0.03) ** 2))
    for begin_s in (0.8, 1.8):
        slip_s = begin_s + 0.5
        sheared = np.clip((t - begin_s) / 0.5, 0, 1) * (t < slip_s)
        impulse = np.exp(-(((t - slip_s) / 6e-3) ** 2)) * np.sin(2 * np.pi * 110 * (t - slip_s))
        v_d = 8e-3 * sheared + 0.05 * impulse
        volts += np.column_stack([v_d, -v_d]) / 2
    return volts + (touch + lift_off)[:, None]


def checks_of(name: str) -> dict[str, Callable[[], None]]:
    """Return the checks of the installed detector `name`, by what they check."""

    def of(check: Callable[[ChosenDetector], None]) -> Callable[[], None]:
        return lambda: check(chosen_detector(name))

    return {check.__name__.removeprefix("_").replace("_", "-"): of(check) for check in _CHECKS}


def _blocks_give_the_events_of_the_whole(chosen: ChosenDetector) -> None:
    volts = recording(_rate(chosen))
    whole = _events(chosen, volts, [len(volts)])
    for size in SIZES:
        _same(_events(chosen, volts, _every(size, len(volts))), whole, f"blocks of {size} rows")
    for seed in range(3):
        cuts = np.random.default_rng(seed).integers(0, len(volts), 40)
        _same(_events(chosen, volts, sorted(cuts)), whole, f"blocks cut at {sorted(cuts.tolist())}")


def _notices_are_taken(chosen: ChosenDetector) -> None:
    """Check that what the bench knows has the same effect with the rows and before all of them."""
    rate_Hz = _rate(chosen)
    volts = recording(rate_Hz)
    moves_s = ((0.8, 0.4, 1.0), (0.9, -0.2, 1.3), (1.8, 0.3, 2.3))
    notices: list[Notice] = [
        XMove(round(begin_s * rate_Hz), speed_mm_s, round(end_s * rate_Hz))
        for begin_s, speed_mm_s, end_s in moves_s
    ]
    for at_s, force_N in ((0.7, 4.0), (1.1, 3.0)):
        notices.append(HeldForce(round(at_s * rate_Hz), force_N))
    for first_s, until_s in ((0.75, 0.76), (1.295, 1.32)):
        notices.append(CutOff(round(first_s * rate_Hz), round(until_s * rate_Hz)))
    notices.sort(key=lambda one: one.sample)
    known = chosen.make(rate_Hz)
    for one in notices:
        known.notice(one)
    whole = [*known.add(volts), *known.finish()]
    for size in SIZES:
        detector, waiting, events = chosen.make(rate_Hz), list(notices), list[SlipEvent]()
        for begin, end in itertools.pairwise(_every(size, len(volts))):
            while waiting and waiting[0].sample < end:
                detector.notice(waiting.pop(0))
            events += detector.add(volts[begin:end])
        _same([*events, *detector.finish()], whole, f"notices of the bench, blocks of {size} rows")


def _events_lie_in_the_rows_in_which_they_were_decided(chosen: ChosenDetector) -> None:
    rate_Hz = _rate(chosen)
    detector, volts = chosen.make(rate_Hz), recording(rate_Hz)
    for first in range(0, len(volts), 5):
        part = volts[first : first + 5]
        for event in detector.add(part, first_sample=first):
            _of_a_known_kind(event, rate_Hz)
            assert first <= event.sample < first + len(part), (
                f"{event} was returned with rows {first} to {first + len(part) - 1}"
            )
    for event in detector.finish():
        _of_a_known_kind(event, rate_Hz)
        assert 0 <= event.sample < len(volts), f"{event}: the recording has {len(volts)} rows"


def _instances_share_nothing(chosen: ChosenDetector) -> None:
    rate_Hz = _rate(chosen)
    volts = recording(rate_Hz)
    other = np.roll(recording(rate_Hz, seed=1), round(0.3 * rate_Hz), axis=0)
    whole = _events(chosen, volts, [len(volts)])
    one, two = chosen.make(rate_Hz), chosen.make(rate_Hz)
    events: list[SlipEvent] = []
    for begin, end in itertools.pairwise(_every(1, len(volts))):
        events += one.add(volts[begin:end])
        two.add(other[begin:end])
    _same([*events, *one.finish()], whole, "another instance that judges other rows meanwhile")
    _same(_events(chosen, volts, [len(volts)]), whole, "an instance that is made later")


def _a_gap_begins_anew(chosen: ChosenDetector) -> None:
    """Make the gap after the whole recording, and within an impulse: what is remembered for a short
    time only must be forgotten as well."""
    rate_Hz = _rate(chosen)
    volts, begin = recording(rate_Hz), round(1.302 * rate_Hz)  # within an impulse
    fresh = chosen.make(rate_Hz).add(volts[begin:])
    for before in (len(volts), begin):
        detector = chosen.make(rate_Hz)
        detector.add(volts[:before])
        first = before + 10
        behind = detector.add(volts[begin:], first_sample=first)
        gaps = [one for one in behind if one.reason.startswith("gap of 10 samples")]
        assert gaps, f"a gap of 10 samples: events {behind}"
        assert detector.rows == first + len(volts) - begin, "rows do not include those missing"
        moved = [
            dataclasses.replace(
                one, sample=one.sample - first, time_s=(one.sample - first) / rate_Hz
            )
            for one in behind
            if one not in gaps
        ]
        _same(moved, fresh, "rows behind a gap, beside the same rows of a new recording")


def _rows_that_cannot_be_are_refused(chosen: ChosenDetector) -> None:
    rate_Hz = _rate(chosen)
    for wrong in (math.nan, math.inf, -math.inf):
        volts = recording(rate_Hz)[:100]
        volts[37, 1] = wrong
        with raising(ValueError, f"a row with {wrong} V") as refused:
            chosen.make(rate_Hz).add(volts)
        assert "v_2" in str(refused.error), f"{refused.error}: does not name the channel"
        assert "37" in str(refused.error), f"{refused.error}: does not name the row"
    for shape in ((5,), (5, 3), (2, 5, 2)):
        with raising(ValueError, f"rows of shape {shape}"):
            chosen.make(rate_Hz).add(np.zeros(shape))
    detector = chosen.make(rate_Hz)
    detector.add(np.zeros((100, 2)), first_sample=0)
    with raising(ValueError, "rows that came twice"):
        detector.add(np.zeros((100, 2)), first_sample=50)


def _a_rate_that_it_does_not_judge_is_refused(chosen: ChosenDetector) -> None:
    kind = chosen.kind
    for rate_Hz in (0.9 * kind.slowest_Hz, 1.1 * kind.fastest_Hz):
        with raising(ValueError, f"a rate of {rate_Hz:g} Hz"):
            kind(chosen.settings, rate_Hz)
    for rate_Hz in (1.0, 200_000.0):
        with raising(ValueError, f"a rate of {rate_Hz:g} Hz"):
            chosen.make(rate_Hz)


def _recordings_at_other_rates_are_judged(chosen: ChosenDetector) -> None:
    for rate_Hz in OTHER_RATES_Hz:
        volts = recording(rate_Hz)
        whole = _events(chosen, volts, [len(volts)])
        for event in whole:
            _of_a_known_kind(event, rate_Hz)
        cut = _every(round(0.002 * rate_Hz), len(volts))
        _same(_events(chosen, volts, cut), whole, f"blocks of 2 ms at {rate_Hz:g} Hz")


def _nothing_is_found_in_nothing(chosen: ChosenDetector) -> None:
    rate_Hz = _rate(chosen)
    assert chosen.make(rate_Hz).finish() == [], "events of a recording without rows"
    assert chosen.make(rate_Hz).add(np.zeros((0, 2))) == [], "events in a block without rows"
    noise = 1e-4 * np.random.default_rng(0).standard_normal((round(3 * rate_Hz), 2))
    slips = [one for one in chosen.make(rate_Hz).add(noise) if one.kind == "incipient slip"]
    assert slips == [], "slips in 3 s of noise of 0.1 mV"


def _rows_are_left_as_they_are(chosen: ChosenDetector) -> None:
    rate_Hz = _rate(chosen)
    given = recording(rate_Hz)
    before = given.copy()
    chosen.kind(chosen.settings, rate_Hz).add(given)
    assert given.tobytes() == before.tobytes(), "it changed the rows that it was given"


def _it_keeps_up_with_a_trial(chosen: ChosenDetector) -> None:
    """Blocks of two rows, as a running trial hands them over, take less time of a processor than
    they last; a slower detector falls behind and is dropped."""
    rate_Hz = _rate(chosen)
    volts, detector = recording(rate_Hz), chosen.make(rate_Hz)
    detector.add(volts[:1])  # what is compiled or loaded at first use is ready before a trial
    begun_s = time.process_time()
    for begin in range(1, len(volts), 2):
        detector.add(volts[begin : begin + 2])
    taken_s = time.process_time() - begun_s
    assert taken_s < DURATION_S, (
        f"{DURATION_S:g} s of rows, two at a time, took {taken_s:.1f} s of a processor: beside a "
        "running trial it would fall behind and be dropped"
    )


def _parameters_survive_json(chosen: ChosenDetector) -> None:
    text = chosen.settings.model_dump_json()
    again = chosen_detector(chosen.name, text)
    assert again == chosen, f"read again from {text}: {again.settings}"


_CHECKS: tuple[Callable[[ChosenDetector], None], ...] = (
    _blocks_give_the_events_of_the_whole,
    _notices_are_taken,
    _events_lie_in_the_rows_in_which_they_were_decided,
    _instances_share_nothing,
    _a_gap_begins_anew,
    _rows_that_cannot_be_are_refused,
    _a_rate_that_it_does_not_judge_is_refused,
    _recordings_at_other_rates_are_judged,
    _nothing_is_found_in_nothing,
    _rows_are_left_as_they_are,
    _it_keeps_up_with_a_trial,
    _parameters_survive_json,
)


def _rate(chosen: ChosenDetector) -> float:
    return chosen.kind.design_rate_Hz


def _every(size: int, rows: int) -> list[int]:
    return [*range(0, rows, size), rows]


def _events(chosen: ChosenDetector, volts: Reals, cuts: Iterable[int]) -> list[SlipEvent]:
    """Return the events of a `recording` that is cut before each row of `cuts`."""
    detector = chosen.make(len(volts) / DURATION_S)
    events: list[SlipEvent] = []
    for begin, end in itertools.pairwise([0, *cuts, len(volts)]):
        events += detector.add(volts[begin:end])
    return [*events, *detector.finish()]


def _same(found: list[SlipEvent], expected: list[SlipEvent], what: str) -> None:
    for number, (one, other) in enumerate(itertools.zip_longest(found, expected)):
        assert one == other, f"{what}: event {number} is {one} where {other} is expected"


def _of_a_known_kind(event: SlipEvent, rate_Hz: float) -> None:
    assert event.kind in EVENT_KINDS, f"{event}: its kind is none of {', '.join(EVENT_KINDS)}"
    assert event.time_s == event.sample / rate_Hz, f"{event}: its time is not that of its row"
    assert 0 <= event.confidence <= 1, f"{event}: its confidence is not from 0 to 1"

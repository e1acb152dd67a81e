"""The compiled core of the detectors. It takes one row of v_1 and v_2 after the other and does
nothing else.

Every row passes through the same scalar operations in the same order, and all state is in one
record. The events therefore do not depend on how the rows arrive: one by one, in blocks or as a
whole file. The compiler must not reorder operations, so fast mathematics stays off.

All of it is one module because numba's cache checks the file of the function that is called, not
the files of those it calls.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

PREDICTIVE, SLIP, ROLL, REJECTED, CANNOT_JUDGE, JUDGES_AGAIN = range(6)
"""Kinds of events, in the order of `rig.detector.events.EVENT_KINDS`."""
(
    NO_REASON,
    NOT_ARMED,
    IS_ROLL,
    COMMON,
    UNLIKE,
    SATURATED,
    NOT_QUIET,
    FIRST_DEAD,
    SECOND_DEAD,
    ONE_INVERTED,
    HUM,
    TOO_NOISY,
    CUT_OFF,
    NOT_SURE,
) = range(14)
REASONS = (
    "",
    "not armed: no motion under load preceded it",
    "roll",
    "common to both channels",
    "unlike a slip",
    "saturated",
    "not quiet: offset and noise cannot be judged",
    "v_1 is dead: constant while v_2 moves",
    "v_2 is dead: constant while v_1 moves",
    "the first touch drives v_1 and v_2 oppositely: one is inverted, or it was not recorded",
    "mains hum: thresholds rise with it",
    "too noisy: a slip would not stand out from the noise",
    "cut off: a strip's voltage left the range of the DAQ",
    "like a slip, but not probable enough for the first of a motion or just after x has turned",
)
"""Reasons of events that reject or cannot judge, in the order of the constants above."""
RIG, LITERAL, HIGH_PASSED, IMPULSE = range(4)
"""Logics, in the order of the names in `rig.detector.detector`."""

AVERAGES_ms = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Time constants of the running averages. The differences of neighbouring averages are the
bands."""
_A = len(AVERAGES_ms)
PEAKS_ms = (3.0, 10.0, 40.0, 10.0)
"""Time constants with which peaks of the impulse decay: three of v_d, one of v_s."""
POWERS_ms = (8.0, 64.0)
"""Time constants of the powers of the impulse."""
SUMS_ms = (100.0, 400.0)
"""Time constants of the leaky sums."""
SLOW_PEAK_ms = 150.0
"""Time constant of the peak of the average over 16 ms."""
PIECES = 4
"""Once offset and noise are known, one piece out of this many is used to update them."""
LOOK_ms, IDLE_ms = 12.0, 8.0
"""The network is evaluated at every row for `LOOK_ms` after an impulse, and otherwise once every
`IDLE_ms`."""
ADAPTIVE_IDLE_ms = 4.0
"""The same for a network of `ADAPTED_INPUTS` or longer ones."""
BACKGROUND_ms = (400.0, 64.0, 400.0)
"""Time constants of further powers of the impulse: of v_d, and two of v_s."""

NO_TOUCH, TOUCHING, TOUCHED, TOUCHING_AGAIN = range(4)
"""Stages of the first touch-down: not yet, under way, over; and, after one that was light, perhaps
another."""
STANDARD_TOUCH = 1720.0
"""Sum of v_s over a touch-down to 4 N on the reference skin, in mV ms. It is 400 to 444 mV ms for
each N (seeds 0 to 7 of the population, 2.4 to 7.0 N), whatever the speed of pressing: the charge
of the film follows the force."""
LEAST_UNIT, LEAST_UNIT_OF_IMPULSE, LARGEST_UNIT = 0.2, 0.05, 4.0
"""Bounds of the unit of the touch, as shares of the standard one; the second is that of the logic
``impulse``, whose threshold follows the touch less steeply. A ridge that is touched more
lightly than the lower one slips with an impulse that is hardly smaller (decision 0107)."""
LEAST_TOUCH, TOUCH_SIGMAS = 6.0, 30.0
"""Smallest sum of a touch-down: in mV ms, and in standard deviations of v_s times ms, which is
twice what noise sums to in 0.3 s."""
TOUCH_CALM_ms, LONGEST_TOUCH_ms = 60.0, 3000.0
"""A touch-down is over once v_s has been below `TOUCH_CALM` of its peak for the first of these,
or after the second."""
TOUCH_CALM = 0.15
MOST_NOISE = 5.0
"""Noise above `impulse_Hz`, rms in mV after a standard touch, above which a network of `INPUTS`
cannot judge: a quarter of the impulse of the reference slide."""
LIGHT_TOUCH = 0.1
"""Touch-down, as a share of the standard one, below which it is light. It may have been a drift, so
that a later one that is not light replaces it."""
WARM_UP_ms = 64.0
"""Time after which offset and noise are known for the first time, for a network of `INPUTS`."""
DRIFT_ms = (2000.0, 1000.0)
"""Time constants with which the offsets of v_d and v_s follow a drift."""
DRIFT_LIMIT = 0.3
"""The offset of v_d follows deviations up to this many mV, in units of the touch, or up to its
noise: 0.15 mV/s at most. A slow slide is a deviation of 1 mV for seconds, which must not be taken
for a drift. That of v_s has no limit: what changes the sum for seconds is a drift or the force."""
NOISE_PIECES = 16
"""Number of latest pieces of which the second least noise is taken: motions and bursts raise the
noise of some pieces, never that of all."""
CHARGE_ms = 4000.0
"""Time constant of the sums of v_d and v_s since the touch-down."""
LONG_PEAKS_ms = (1000.0, 1000.0, 400.0)
"""Time constants with which the long peaks decay: of the average of v_d over 16 ms, of the size of
the sum of v_d since the touch-down, and of the impulse of v_d."""
COMMAND_ms = (30.0, 60.0)
"""Time constants with which a commanded braking and a commanded start of x are forgotten."""
FORCE_ms = (60.0, 400.0)
"""Time constants with which commanded changes of the normal force are forgotten."""
LEAST_SPEED_mm_s = 0.02
"""Lowest commanded speed at which v_d is compared with it."""
LEAST_SHARE = 0.02
"""Smallest touch-down, as a share of the standard one, with which the sums are compared."""
LEAST_SILENCE_ms = 40.0
"""Shortest time between two reported slips, where the settings state none."""
ROLLING_ms = 100.0
"""A roll is reported only after v_d has shown a motion under load for this long without a break,
and after the first touch-down. The longest tap (40 ms) shows in it for 80 ms."""

STATE = np.dtype(
    [
        ("row", "i8"),
        ("ready", "i8"),
        ("offset", "f8", (2,)),  # of v_d and v_s, mV
        ("noise", "f8", (2,)),  # of v_d and v_s, mV
        ("fast_noise", "f8", (2,)),  # the same above impulse_Hz
        ("fresh_offset", "f8", (4,)),  # of the last piece: v_d, v_s, both above impulse_Hz
        ("fresh_noise", "f8", (4,)),
        ("piece_rows", "i8"),
        ("wait_rows", "i8"),
        ("restless_rows", "i8"),
        ("low", "f8"),  # low-passed v_d
        ("fast", "f8", (2,)),  # high-passed
        ("sections", "f8", (2, 2, 2)),
        ("average", "f8", (2, _A)),
        ("peak", "f8", (4,)),  # of |fast|, over PEAKS_ms
        ("power", "f8", (3,)),  # of fast: v_d over both POWERS_ms, v_s over the first
        ("sum", "f8", (4,)),  # v_d and v_s over SUMS_ms[0], then [1]
        ("slow_peak", "f8", (2,)),  # of the averages over 16 ms
        ("touch", "f8", (2,)),  # sums of v_d and v_s over the first touch, mV ms
        ("touched", "i8"),
        ("last", "f8", (2,)),  # v_1 and v_2 before, mV
        ("still", "i8", (2,)),  # rows without any change
        ("still_at", "f8", (2,)),  # the other channel when that began
        ("still_span", "f8", (2,)),  # how far the other has moved since
        ("hum_reported", "i8"),
        ("armed", "i8"),
        ("armed_rows", "i8"),
        ("calm_rows", "i8"),
        ("moving_rows", "i8"),  # rows for which v_d has shown a motion under load, without a break
        ("roll_reported", "i8"),
        ("slip_reported", "i8"),  # since it was last disarmed
        ("roll_rows", "i8"),
        ("look_rows", "i8"),
        ("silent_rows", "i8"),
        ("suppressed_rows", "i8"),
        ("suspect_rows", "i8"),
        ("mute_rows", "i8"),
        ("suspect", "f8", (4,)),  # impulse, its threshold, common part, probability if withheld
        ("slip", "f8"),
        ("roll", "f8"),
        ("unjudged", "i8"),  # reason for which nothing is judged, or NO_REASON
        ("unjudged_from", "i8"),  # first row of that time
        ("suppressed_by", "i8"),  # reason of suppressed_rows
        ("is_cut_off", "i8"),  # whether the DAQ cuts a strip off
        ("stage", "i8"),  # of the first touch-down
        ("stage_rows", "i8"),
        ("stage_calm_rows", "i8"),
        ("pressed", "f8", (3,)),  # in the touch-down: sum of v_s, its largest size, peak of v_s
        ("unit", "f8"),  # unit of the touch, as a share of the standard one
        ("light", "i8"),  # 1 if the touch-down was light
        ("background", "f8", (3,)),  # powers of fast over BACKGROUND_ms
        ("known_rows", "i8"),  # rows on which offset and noise could be measured
        ("noises", "f8", (4, NOISE_PIECES)),  # of the latest pieces
        ("noise_pieces", "i8", (4,)),  # number of pieces so far
        ("braking_rows", "i8"),  # rows for which x counts as braking by command
        ("touch_share", "f8"),  # touch-down as a share of the standard one, without a bound above
        ("charge", "f8", (2,)),  # sums of v_d and v_s since the touch-down, mV ms
        ("charge_offset", "f8", (2,)),  # offsets of v_d and v_s in these sums, mV
        ("long_peak", "f8", (3,)),  # over LONG_PEAKS_ms
        ("x_known", "i8"),  # 1 from the first command of x on
        ("x_speed", "f8"),  # commanded speed of x, mm/s
        ("x_gain", "f8"),  # largest v_d for the speed of x, mV s/mm, decaying
        ("x_braked", "f8"),  # 1 where x was commanded to brake, decaying
        ("x_started", "f8"),  # 1 where x was commanded to start or turn, decaying
        ("turning_until", "i8"),  # row before which x counts as turning by command
        ("force_known", "i8"),  # 1 from the first command of the normal force on
        ("force_share", "f8"),  # commanded normal force over the first one since the reset
        ("force_changes", "f8", (2,)),  # sums of its relative changes, decaying over FORCE_ms
    ]
)
"""State of the detector between two rows. All voltages are in mV."""

CONSTANTS = np.dtype(
    [
        ("logic", "i8"),
        ("adapts", "i8"),  # 1 unless it is a network of FIXED_INPUTS or a published logic
        ("ms", "f8"),  # rows in a millisecond
        ("quiet_rows", "i8"),
        ("least_noise", "f8"),
        ("low_noise", "f8"),  # noise behind the low-pass, as a share of that before
        ("arm", "f8", (2,)),  # mV, sigmas
        ("armed_rows", "i8"),
        ("fire", "f8", (2,)),
        ("look", "f8", (2,)),
        ("look_rows", "i8"),
        ("idle_rows", "i8"),
        ("fire_probability", "f8", (2,)),  # without and with the commands of x
        ("first_probability", "f8"),  # of the first slip since it was disarmed; 0: no other one
        ("turn_probability", "f8"),  # shortly after a commanded turn of x; 0: no other one
        ("roll_probability", "f8"),
        ("silent_rows", "i8"),
        ("least_silent_rows", "i8"),
        ("over_probability", "f8"),  # 0 where a slip is over after silent_rows only
        ("saturation", "f8"),
        ("dead_rows", "i8"),
        ("dead_span", "f8"),
        ("hum", "f8"),
        ("turn", "f8", (2,)),  # of the mains in a row, 50 and 60 Hz, rad
        ("share", "f8", (_A,)),  # of a new row in the averages
        ("row_ms", "f8"),
        ("peak_keeps", "f8", (4,)),  # from row to row
        ("power_share", "f8", (2,)),  # of a new row
        ("sum_keeps", "f8", (2,)),
        ("slow_keeps", "f8"),
        ("background_share", "f8", (3,)),
        ("drift_share", "f8", (2,)),
        ("warm_up_rows", "i8"),
        ("rolling_rows", "i8"),
        ("least_unit", "f8"),
        ("touch_exponent", "f8"),  # of thresholds by the unit
        ("braking_share", "f8"),
        ("charge_keeps", "f8"),
        ("long_keeps", "f8", (3,)),
        ("command_keeps", "f8", (2,)),
        ("force_keeps", "f8", (2,)),
    ]
)
"""Settings of the detector, converted to rows and mV."""

FIXED_INPUTS = (
    *(f"v_d band {AVERAGES_ms[k]:g} to {AVERAGES_ms[k + 1]:g} ms" for k in range(_A - 1)),
    f"v_d {AVERAGES_ms[-1]:g} ms",
    *(f"v_s band {AVERAGES_ms[k]:g} to {AVERAGES_ms[k + 1]:g} ms" for k in range(_A - 1)),
    f"v_s {AVERAGES_ms[-1]:g} ms",
    "impulse of v_d",
    "impulse of v_s",
    "impulse of v_d to noise",
    "peak of v_d 3 ms",
    "peak of v_d 10 ms",
    "peak of v_d 40 ms",
    "peak of v_s 10 ms",
    "peak of v_d 10 ms to noise",
    "rms of v_d 8 ms to noise",
    "rms of v_d 64 ms to noise",
    "rms of v_s 8 ms to noise",
    "sum of v_d 100 ms",
    "sum of v_s 100 ms",
    "sum of v_d 400 ms",
    "sum of v_s 400 ms",
    "recent peak of v_d 16 ms",
    "recent peak of v_s 16 ms",
    "v_d 16 ms to its recent peak",
    "noise of v_d",
    "noise of v_s",
    "armed for",
)
"""Names of the inputs of networks that were trained before the detector adapted itself.

The sign of v_d is chosen so that its average over 32 ms is positive, and that of v_s so that
pressing was negative: swapped channels and inverted polarity make no difference. Large numbers are
compressed by x / sqrt(1 + |x|). Voltages are in units of 0.5 mV.
"""

ADAPTED_INPUTS = (
    *FIXED_INPUTS,
    "rms of v_d 400 ms to noise",
    "rms of v_s 64 ms to noise",
    "rms of v_s 400 ms to noise",
    "rms of v_d 8 ms to 400 ms",
    "touch to noise",
    "touched",
)
"""Names of the inputs of networks of decision 0090.

Signs and compression are those of `FIXED_INPUTS`. Voltages are in units of the first touch: 0.5 mV
times the sum of v_s over the touch-down, as a share of `STANDARD_TOUCH`. So neither the gain of the
amplifiers nor, in the main, the normal force makes a difference; "touch to noise" is how the
noise compares with both. Until the touch-down is over the unit is 0.5 mV and "touched" is 0.
"""

CHARGED_INPUTS = (
    *ADAPTED_INPUTS,
    "sum of v_d since the touch to the touch",
    "sum of v_s since the touch to the touch",
    "sum of v_d since the touch to the force",
    "sum of v_d since the touch to its long peak",
    "v_d 16 ms to its long peak",
    "peak of v_d 10 ms to its long peak",
    "v_d along the shear 2 ms to its long peak",
    "v_d along the shear 4 ms to its long peak",
    "v_d along the shear 8 ms to its long peak",
    "impulse of v_d along the shear",
    "x known",
    "speed of x",
    "x braked",
    "x started",
    "v_d 8 ms to the speed of x",
    "v_d missing while x moves",
)
"""Names of the inputs of networks of decision 0121.

A film's charge follows the force, so that the sums since the touch-down are the shear and the
change of the normal force of the ridge, in units of the touch: how much of the friction is used,
whether the shear still grows, and whether v_d still follows x. "Along the shear" is positive where
the shear grows. The last six are 0 where the commands of x are not known.
"""

INPUTS = (
    *CHARGED_INPUTS,
    "force known",
    "change of force 60 ms",
    "change of force 400 ms",
    "force to the first",
    "sum of v_d since the touch to the commanded force",
)
"""Names of the inputs of networks that are trained now (decision 0124).

The normal force is the one that z is commanded to hold, not the measured one. All five are 0 where
it is not known.
"""

EVENT_FEATURES = (
    "predictive_mV",
    "impulse_mV",
    "common_impulse_mV",
    "threshold_mV",
    "slip_probability",
    "roll_probability",
)
"""Names of the numbers that are reported with every event."""
EVENT_COLUMNS = 4 + len(EVENT_FEATURES) + 1
"""Number of columns of an event: kind, row, confidence, reason, features, rows not judged."""

_MEDIAN_TO_SIGMA = 1.4826
_FIXED, _ADAPTED, _CHARGED = len(FIXED_INPUTS), len(ADAPTED_INPUTS), len(CHARGED_INPUTS)


@njit(cache=True, error_model="numpy")
def advance(
    volts: Any,
    state: Any,
    line: Any,
    piece: Any,
    room: Any,
    constants: Any,
    taps: Any,
    sections: Any,
    hidden: Any,
    output: Any,
    units: Any,
    events: Any,
    seen: Any,
    looked: Any,
) -> int:
    """Take rows of volts (n, 2), fill `events` (n, columns) and return the number of events.

    Return -1 if a value is not finite; no row was taken then.

    `line` (taps,) and `piece` (4, quiet rows) are part of the state, `room` (quiet rows,) and
    `units` are work space. `hidden` (inputs + 1, units) and `output` (2, units + 1) are the weights
    of the network. If `looked` has rows, the inputs of the network are saved in `seen` (n, inputs),
    and `looked` (n,) is true where it was evaluated.
    """
    for k in range(volts.shape[0]):
        if not (math.isfinite(volts[k, 0]) and math.isfinite(volts[k, 1])):
            return -1
    s, c = state[0], constants[0]
    reported = 0
    for k in range(volts.shape[0]):
        first, second = 1e3 * volts[k, 0], 1e3 * volts[k, 1]
        _check_channels(first, second, s, c)
        if abs(first) >= c.saturation or abs(second) >= c.saturation:
            # The last good row replaces a saturated one: the step into saturation would make the
            # filters ring.
            first, second = s.last[0], s.last[1]
        s.last[0], s.last[1] = first, second
        _filter(first, second, s, line, c, taps, sections)
        if c.adapts:
            reported = _adapt(first, second, s, piece, room, c, events, reported)
        else:
            reported = _judge_quiet(first, second, s, piece, room, c, events, reported)
        reported = _say_whether_it_judges(s, c, events, reported)
        if s.ready:
            reported = _update_features(first, second, s, c, events, reported)
            if c.logic == RIG or c.logic == IMPULSE:
                _follow_touch(s, c)
            reported = _arm(s, c, events, reported)
            if c.logic == RIG:
                looks = _network_due(s, c)
                if looks:
                    if c.adapts:
                        _gather_inputs(s, c, seen[k if looked.size else 0])
                    else:
                        _gather_fixed_inputs(s, c, seen[k if looked.size else 0])
                    _evaluate_network(seen[k if looked.size else 0], hidden, output, units, s)
                if looked.size:
                    looked[k] = looks
                reported = _decide(looks, s, c, events, reported)
            elif c.logic == IMPULSE:
                reported = _compare_with_touch(s, c, events, reported)
            else:
                reported = _compare(first, second, s, c, events, reported)
        s.row += 1
    return reported


@njit(cache=True, error_model="numpy")
def _check_channels(first: float, second: float, s: Any, c: Any) -> None:
    """Suppress events until 50 ms after a channel was saturated, cut off or dead."""
    if s.suppressed_rows > 0:
        s.suppressed_rows -= 1
    now = round(50.0 * c.ms) + 1
    if abs(first) >= c.saturation or abs(second) >= c.saturation:
        s.suppressed_rows = now
        s.suppressed_by = SATURATED
    if s.is_cut_off:
        s.suppressed_rows = now
        s.suppressed_by = CUT_OFF
    for j in range(2):
        x, other = (first, second) if j == 0 else (second, first)
        if x != s.last[j] or s.row == 0:
            s.still[j] = 0
            s.still_at[j] = other
            s.still_span[j] = 0.0
            continue
        s.still[j] += 1
        s.still_span[j] = max(s.still_span[j], abs(other - s.still_at[j]))
        if s.still[j] >= c.dead_rows and s.still_span[j] > c.dead_span and abs(x) < c.saturation:
            if s.suppressed_rows == 0:
                s.suppressed_by = FIRST_DEAD + j
            s.suppressed_rows = now


@njit(cache=True, error_model="numpy")
def _say_whether_it_judges(s: Any, c: Any, events: Any, reported: int) -> int:
    """Report when nothing can be judged from now on, with the reason, and when that is over."""
    reason = NO_REASON
    if s.suppressed_rows > 0:
        reason = s.suppressed_by
    elif not s.ready:
        # A beginning that is restless for less than four pieces is not worth an event.
        if s.restless_rows >= 4 * c.quiet_rows:
            reason = NOT_QUIET
    elif c.adapts and _has_touched(s):
        # A fifth less is asked for to judge again, so that it does not go to and fro.
        most = MOST_NOISE * s.unit**c.touch_exponent * (0.8 if s.unjudged == TOO_NOISY else 1.0)
        if s.fast_noise[0] > most:
            reason = TOO_NOISY
    if reason == NO_REASON and s.unjudged != NO_REASON:
        was = s.unjudged
        s.unjudged = NO_REASON
        return _report(JUDGES_AGAIN, 0.0, was, 0.0, 0.0, s, events, reported)
    if reason != NO_REASON and s.unjudged == NO_REASON:
        s.unjudged = reason
        s.unjudged_from = s.row
        if reason == NOT_QUIET:
            s.unjudged_from = 0
        elif reason in (FIRST_DEAD, SECOND_DEAD):
            s.unjudged_from = s.row - s.still[reason - FIRST_DEAD]
        return _report(CANNOT_JUDGE, 0.0, reason, 0.0, 0.0, s, events, reported)
    return reported


@njit(cache=True, error_model="numpy")
def _filter(
    first: float, second: float, s: Any, line: Any, c: Any, taps: Any, sections: Any
) -> None:
    """Apply the low-pass to v_d and the high-pass to v_d and v_s, as if the first row had been
    present forever."""
    _low_pass(first - second, s, line, taps)
    for channel in range(2):
        y = first - second if channel == 0 else first + second
        if s.row == 0:
            _rest(y, s.sections[channel], sections)
        for q in range(sections.shape[0]):
            b0, b1, b2 = sections[q, 0], sections[q, 1], sections[q, 2]
            a1, a2 = sections[q, 4], sections[q, 5]
            out = b0 * y + s.sections[channel, q, 0]
            s.sections[channel, q, 0] = b1 * y - a1 * out + s.sections[channel, q, 1]
            s.sections[channel, q, 1] = b2 * y - a2 * out
            y = out
        s.fast[channel] = y


@njit(cache=True, error_model="numpy")
def _low_pass(x: float, s: Any, line: Any, taps: Any) -> None:
    """Run the filter in its transposed form.

    Its partial sums do not depend on one another, so that the compiler may use vector instructions
    without changing the order of any sum.
    """
    n = taps.size
    if s.row == 0:
        tail = 0.0
        for i in range(n - 1, 0, -1):
            tail += taps[i]
            line[i - 1] = tail * x
        line[n - 1] = 0.0
    s.low = line[0] + taps[0] * x
    for i in range(n - 1):
        line[i] = line[i + 1] + taps[i + 1] * x


@njit(cache=True, error_model="numpy")
def _rest(x: float, memory: Any, sections: Any) -> None:
    """Set the memory of the high-pass sections to its value after a constant input."""
    y = x
    for q in range(sections.shape[0]):
        b0, b1, b2 = sections[q, 0], sections[q, 1], sections[q, 2]
        a1, a2 = sections[q, 4], sections[q, 5]
        out = y * (b0 + b1 + b2) / (1.0 + a1 + a2)
        memory[q, 1] = b2 * y - a2 * out
        memory[q, 0] = b1 * y - a1 * out + memory[q, 1]
        y = out


@njit(cache=True, error_model="numpy")
def _judge_quiet(
    first: float, second: float, s: Any, piece: Any, room: Any, c: Any, events: Any, reported: int
) -> int:
    """Measure offset and noise on the last piece if it was quiet.

    They are medians, so that single spikes have no influence. Before the first quiet piece nothing
    else is judged.
    """
    if s.ready and (s.armed or s.suppressed_rows > 0):
        s.piece_rows = 0
        return reported
    if s.wait_rows > 0:
        s.wait_rows -= 1
        return reported
    at = s.piece_rows
    piece[0, at] = first - second
    piece[1, at] = first + second
    piece[2, at] = s.fast[0]
    piece[3, at] = s.fast[1]
    s.piece_rows += 1
    if s.piece_rows < c.quiet_rows:
        return reported
    s.piece_rows = 0
    s.wait_rows = s.ready * (PIECES - 1) * c.quiet_rows
    offset, noise = s.fresh_offset, s.fresh_noise
    quiet = True
    for j in range(4):
        offset[j], noise[j] = _middle_and_noise(piece[j], room, c)
        if j < 2 and not _is_quiet(piece[j], offset[j], noise[j]):
            quiet = False
    if not quiet:
        s.restless_rows += c.quiet_rows
        return reported
    hum = max(_hum(piece[0], offset[0], c), _hum(piece[1], offset[1], c) / 2.0)
    if hum > c.hum and not s.hum_reported:
        s.hum_reported = 1
        reported = _report(REJECTED, 0.0, HUM, hum, c.hum, s, events, reported)
    # Later pieces count for a quarter, so that one odd piece does not move offset and noise far.
    weight = 0.25 if s.ready else 1.0
    for j in range(2):
        s.offset[j] += weight * (offset[j] - s.offset[j])
        s.noise[j] += weight * (noise[j] - s.noise[j])
        s.fast_noise[j] += weight * (noise[2 + j] - s.fast_noise[j])
    s.ready = 1
    return reported


@njit(cache=True, error_model="numpy")
def _adapt(
    first: float, second: float, s: Any, piece: Any, room: Any, c: Any, events: Any, reported: int
) -> int:
    """Measure offset and noise without waiting for quiet.

    Both are known from the first rows, and follow from then on. The noise is the second least of
    the latest pieces. The four signals' pieces end at different rows, so that no row has to wait
    for more than two medians.
    """
    if s.suppressed_rows > 0:
        return reported
    n, quarter = c.quiet_rows, c.quiet_rows // 4
    x = (first - second, first + second, s.fast[0], s.fast[1])
    s.known_rows += 1
    for j in range(4):
        at = (s.known_rows - 1 + j * quarter) % n
        piece[j, at] = x[j]
        if at == n - 1 and s.known_rows >= n:
            middle, noise = _middle_and_noise(piece[j], room, c)
            _take_noise(j, noise, s)
            looks = j < 2 and s.stage == NO_TOUCH and not s.hum_reported
            if looks and _is_quiet(piece[j], middle, noise):
                hum = _hum(piece[j], middle, c) / (1.0 + j)
                if hum > c.hum:
                    s.hum_reported = 1
                    reported = _report(REJECTED, 0.0, HUM, hum, c.hum, s, events, reported)
    if s.ready:
        return reported
    if s.known_rows == c.warm_up_rows:
        for j in range(4):
            begin = j * quarter
            part = piece[j, begin : begin + c.warm_up_rows]
            middle, noise = _middle_and_noise(part, room[: c.warm_up_rows], c)
            if j < 2:
                s.offset[j] = middle
                s.noise[j] = noise
            else:
                s.fast_noise[j - 2] = noise
        s.unit = 1.0
        s.touch_share = 1.0
        for j in range(2):
            s.charge_offset[j] = s.offset[j]
        s.ready = 1
    return reported


@njit(cache=True, error_model="numpy")
def _take_noise(j: int, noise: float, s: Any) -> None:
    """Take the noise of a signal's latest piece: v_d, v_s, both above impulse_Hz."""
    s.noises[j, s.noise_pieces[j] % NOISE_PIECES] = noise
    s.noise_pieces[j] += 1
    least, second = math.inf, math.inf
    for i in range(min(s.noise_pieces[j], NOISE_PIECES)):
        one = s.noises[j, i]
        if one < least:
            least, second = one, least
        elif one < second:
            second = one
    chosen = second if s.noise_pieces[j] > 2 else least
    if j < 2:
        s.noise[j] = chosen
    else:
        s.fast_noise[j - 2] = chosen


@njit(cache=True, error_model="numpy")
def _middle_and_noise(values: Any, room: Any, c: Any) -> tuple[float, float]:
    """Return the median, and the median distance from it as a standard deviation."""
    n = values.size
    for i in range(n):
        room[i] = values[i]
    middle = _median(room)
    for i in range(n):
        room[i] = abs(values[i] - middle)
    return middle, max(_MEDIAN_TO_SIGMA * _median(room), c.least_noise)


@njit(cache=True, error_model="numpy")
def _median(values: Any) -> float:
    """Return the median; partly sorts the values (Hoare's quickselect)."""
    n = values.size
    wanted = n // 2
    low, high = 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            break
    middle: float = values[wanted]
    if n % 2 == 0:
        below = values[0]
        for i in range(1, wanted):
            below = max(below, values[i])
        middle = (below + middle) / 2.0
    return middle


@njit(cache=True, error_model="numpy")
def _is_quiet(values: Any, middle: float, noise: float) -> bool:
    """Return whether a piece neither drifted nor jumped."""
    n = values.size
    half = n // 2
    moved, largest = 0.0, 0.0
    for i in range(n):
        moved += values[i] if i < half else -values[i]
        largest = max(largest, abs(values[i] - middle))
    if n % 2:
        moved += middle
    jumps = largest > 10.0 * noise + 0.5
    drifts = abs(moved) / half > 8.0 * noise / math.sqrt(half) + 0.1
    return not (jumps or drifts)


@njit(cache=True, error_model="numpy")
def _hum(values: Any, middle: float, c: Any) -> float:
    """Return the amplitude at the mains frequency, the larger of 50 and 60 Hz."""
    n = values.size
    largest = 0.0
    for j in range(2):
        real, imaginary = 0.0, 0.0
        for i in range(n):
            real += (values[i] - middle) * math.cos(c.turn[j] * i)
            imaginary += (values[i] - middle) * math.sin(c.turn[j] * i)
        largest = max(largest, 2.0 * math.sqrt(real * real + imaginary * imaginary) / n)
    return largest


@njit(cache=True, error_model="numpy")
def _update_features(
    first: float, second: float, s: Any, c: Any, events: Any, reported: int
) -> int:
    """Update averages, peaks, powers and sums with the new row, and the first touch."""
    d = first - second - s.offset[0]
    v = first + second - s.offset[1]
    for j in range(_A):
        s.average[0, j] += c.share[j] * (d - s.average[0, j])
        s.average[1, j] += c.share[j] * (v - s.average[1, j])
    fast_d, fast_s = abs(s.fast[0]), abs(s.fast[1])
    for j in range(4):
        s.peak[j] = max(fast_s if j == 3 else fast_d, s.peak[j] * c.peak_keeps[j])
    s.power[0] += (fast_d * fast_d - s.power[0]) * c.power_share[0]
    s.power[1] += (fast_d * fast_d - s.power[1]) * c.power_share[1]
    s.power[2] += (fast_s * fast_s - s.power[2]) * c.power_share[0]
    s.sum[0] = s.sum[0] * c.sum_keeps[0] + d * c.row_ms
    s.sum[1] = s.sum[1] * c.sum_keeps[0] + v * c.row_ms
    s.sum[2] = s.sum[2] * c.sum_keeps[1] + d * c.row_ms
    s.sum[3] = s.sum[3] * c.sum_keeps[1] + v * c.row_ms
    for j in range(2):
        s.slow_peak[j] = max(abs(s.average[j, 4]), s.slow_peak[j] * c.slow_keeps)
    if c.adapts:
        s.background[0] += (fast_d * fast_d - s.background[0]) * c.background_share[0]
        s.background[1] += (fast_s * fast_s - s.background[1]) * c.background_share[1]
        s.background[2] += (fast_s * fast_s - s.background[2]) * c.background_share[2]
        _follow_drift(d, v, s, c)
        _follow_charges(first - second, first + second, s, c)
    return reported if s.touched else _touch(s, c, events, reported)


@njit(cache=True, error_model="numpy")
def _follow_charges(difference: float, total: float, s: Any, c: Any) -> None:
    """Update the sums of v_d and v_s, of which the new row has `difference` and `total`, the long
    peaks, and the memory of commands.

    The sums have offsets of their own, from the end of the touch-down: those that follow the signal
    would take what is left of the press, or a slow shear, for an offset.
    """
    d, v = difference - s.charge_offset[0], total - s.charge_offset[1]
    s.charge[0] = s.charge[0] * c.charge_keeps + d * c.row_ms
    s.charge[1] = s.charge[1] * c.charge_keeps + v * c.row_ms
    s.long_peak[0] = max(abs(s.average[0, 4]), s.long_peak[0] * c.long_keeps[0])
    s.long_peak[1] = max(abs(s.charge[0]), s.long_peak[1] * c.long_keeps[1])
    s.long_peak[2] = max(abs(s.fast[0]), s.long_peak[2] * c.long_keeps[2])
    s.x_gain *= c.long_keeps[1]
    if abs(s.x_speed) > LEAST_SPEED_mm_s:
        s.x_gain = max(abs(s.average[0, 4]) / abs(s.x_speed), s.x_gain)
    s.x_braked *= c.command_keeps[0]
    s.x_started *= c.command_keeps[1]
    for j in range(2):
        s.force_changes[j] *= c.force_keeps[j]


@njit(cache=True, error_model="numpy")
def _follow_drift(d: float, v: float, s: Any, c: Any) -> None:
    """Move the offsets towards v_d and v_s, which deviate from them by `d` and `v`.

    Not in a touch-down: that is not drift. Before it, the offsets become means of all rows so far.
    """
    if s.stage == TOUCHING:
        return
    limit = max(DRIFT_LIMIT * s.unit, s.noise[0])
    begin = 1.0 / s.known_rows if s.stage == NO_TOUCH else 0.0
    s.offset[0] += max(-limit, min(limit, d)) * max(c.drift_share[0], begin)
    s.offset[1] += v * c.drift_share[1]


@njit(cache=True, error_model="numpy")
def _has_touched(s: Any) -> bool:
    """Return whether a touch-down is over and no other, which would replace it, is under way."""
    touched: bool = s.stage == TOUCHED or s.stage == TOUCHING_AGAIN
    return touched


@njit(cache=True, error_model="numpy")
def _follow_touch(s: Any, c: Any) -> None:
    """Follow the first touch-down; at its end its size becomes the unit of the network's inputs,
    and what v_d and v_s are then becomes their offset.

    A light one, which may have been a drift, is replaced by the next that is not light. Until that
    is known the network judges on: what v_s shows may be a slip as well.
    """
    if s.stage == TOUCHED and not (s.light and c.adapts):
        return
    level = abs(s.average[1, 4])
    threshold = _touch_threshold(1, s, c)
    if s.stage == NO_TOUCH or s.stage == TOUCHED:
        if level > threshold:
            s.stage = TOUCHING if s.stage == NO_TOUCH else TOUCHING_AGAIN
            s.stage_rows, s.stage_calm_rows = 0, 0
            s.pressed[0], s.pressed[1], s.pressed[2] = 0.0, 0.0, 0.0
        return
    s.stage_rows += 1
    s.pressed[0] += s.average[1, 4] / c.ms
    s.pressed[1] = max(s.pressed[1], abs(s.pressed[0]))
    s.pressed[2] = max(s.pressed[2], level)
    share = s.pressed[1] / STANDARD_TOUCH
    if s.stage == TOUCHING_AGAIN and share >= LIGHT_TOUCH:
        s.stage = TOUCHING
    calm = level < max(threshold, TOUCH_CALM * s.pressed[2])
    s.stage_calm_rows = s.stage_calm_rows + 1 if calm else 0
    if s.stage_calm_rows < TOUCH_CALM_ms * c.ms and s.stage_rows < LONGEST_TOUCH_ms * c.ms:
        return
    if s.stage == TOUCHING_AGAIN:
        s.stage = TOUCHED
        return
    if s.pressed[1] < max(LEAST_TOUCH, TOUCH_SIGMAS * s.noise[1]):
        s.stage = NO_TOUCH
        return
    s.stage = TOUCHED
    s.moving_rows = 0
    if not c.adapts:
        return
    s.light = share < LIGHT_TOUCH
    s.unit = min(max(share, c.least_unit), LARGEST_UNIT)
    s.touch_share = max(share, LEAST_SHARE)
    for j in range(2):
        s.charge[j] = 0.0
        s.charge_offset[j] = s.offset[j] + s.average[j, 4]
    for j in range(3):
        s.long_peak[j] = 0.0
    s.x_gain = 0.0
    for j in range(2):
        moved = s.average[j, _A - 1]
        s.offset[j] += moved
        for i in range(_A):
            s.average[j, i] -= moved


@njit(cache=True, error_model="numpy")
def _touch_threshold(j: int, s: Any, c: Any) -> float:
    """Return the average over 16 ms above which something touches: of v_d (0) or v_s (1)."""
    floor_mV = 0.15 if c.adapts else 0.5
    threshold: float = 5.0 * s.noise[j] / math.sqrt(16.0 * c.ms) + floor_mV
    return threshold


@njit(cache=True, error_model="numpy")
def _touch(s: Any, c: Any, events: Any, reported: int) -> int:
    """Learn the polarity from the first touch: pressing drives both strips alike and v_s
    negative."""
    for j in range(2):
        if abs(s.average[j, 4]) > _touch_threshold(j, s, c):
            s.touch[j] += s.average[j, 4] / c.ms
    # In 900 simulated presses |sum of v_d| was at most 0.75 |sum of v_s| (decision 0049).
    if abs(s.touch[0]) + abs(s.touch[1]) < 300.0:
        return reported
    s.touched = 1
    if abs(s.touch[0]) > abs(s.touch[1]):
        return _report(REJECTED, 0.0, ONE_INVERTED, 0.0, 0.0, s, events, reported)
    return reported


@njit(cache=True, error_model="numpy")
def _unit(s: Any, c: Any) -> float:
    """Return the factor on thresholds in mV: the unit of the touch, 1 where nothing adapts."""
    unit: float = s.unit if c.adapts else 1.0
    return unit


@njit(cache=True, error_model="numpy")
def _arm(s: Any, c: Any, events: Any, reported: int) -> int:
    """Arm the detector while the predictive signal is above its threshold."""
    if s.silent_rows > 0:
        s.silent_rows -= 1
    if s.mute_rows > 0:
        s.mute_rows -= 1
    threshold = max(c.arm[0] * _unit(s, c), c.arm[1] * c.low_noise * s.noise[0])
    level = abs(s.low - s.offset[0])
    s.moving_rows = s.moving_rows + 1 if level > threshold / 2.0 else 0
    if s.armed:
        s.armed_rows += 1
        s.calm_rows = 0 if level > threshold / 2.0 else s.calm_rows + 1
        if s.calm_rows > c.armed_rows:
            s.armed = 0
            s.slip_reported = 0
            s.roll_reported = 0
            s.roll_rows = 0
    elif level > threshold:
        s.armed = 1
        s.armed_rows = 0
        s.calm_rows = 0
        confidence = level / (level + threshold)
        return _report(PREDICTIVE, confidence, NO_REASON, 0.0, threshold, s, events, reported)
    return reported


@njit(cache=True, error_model="numpy")
def _compare(first: float, second: float, s: Any, c: Any, events: Any, reported: int) -> int:
    """Report a slip (published logics) where the signal exceeds its threshold while armed."""
    if c.logic == LITERAL:
        level, noise = abs(first - second - s.offset[0]), s.noise[0]
    else:
        level, noise = abs(s.fast[0]), s.fast_noise[0]
    threshold = max(c.fire[0], c.fire[1] * noise)
    if level <= threshold or s.suppressed_rows > 0:
        return reported
    confidence = level / (level + threshold)
    if s.armed:
        if s.silent_rows == 0:
            s.silent_rows = c.silent_rows
            return _report(SLIP, confidence, NO_REASON, level, threshold, s, events, reported)
    elif s.mute_rows == 0:
        s.mute_rows = c.silent_rows
        return _report(REJECTED, confidence, NOT_ARMED, level, threshold, s, events, reported)
    return reported


@njit(cache=True, error_model="numpy")
def _compare_with_touch(s: Any, c: Any, events: Any, reported: int) -> int:
    """Logic ``impulse``: reports a slip where the impulse is above a threshold that grows with the
    touch-down, while the ridge touches, whether it is armed or not.

    A stop or a turn of x that was commanded changes v_d by about its level, hence the larger
    threshold for some time after it. In a record that begins in contact the motion has to arm.
    """
    level = abs(s.fast[0])
    threshold = max(c.fire[0] * s.unit**c.touch_exponent, c.fire[1] * s.fast_noise[0])
    if s.braking_rows > 0:
        s.braking_rows -= 1
        threshold += c.braking_share * s.slow_peak[0]
    touches = _has_touched(s) or (s.stage == NO_TOUCH and s.armed)
    if level <= threshold or not touches or s.unjudged != NO_REASON or s.silent_rows > 0:
        return reported
    s.silent_rows = c.silent_rows
    confidence = level / (level + threshold)
    return _report(SLIP, confidence, NO_REASON, level, threshold, s, events, reported)


@njit(cache=True, error_model="numpy")
def _network_due(s: Any, c: Any) -> bool:
    """Return whether the network is evaluated at this row."""
    threshold = max(c.look[0] * _unit(s, c), c.look[1] * s.fast_noise[0])
    if abs(s.fast[0]) > threshold:
        s.look_rows = c.look_rows
    elif s.look_rows > 0:
        s.look_rows -= 1
    if s.unjudged != NO_REASON or not (s.armed or (c.adapts and _has_touched(s))):
        return False
    looks: bool = s.look_rows > 0 or s.row % c.idle_rows == 0
    return looks


@njit(cache=True, error_model="numpy")
def _gather_fixed_inputs(s: Any, c: Any, x: Any) -> None:
    """Compute the inputs of a network of `FIXED_INPUTS`."""
    _gather(1.0, s, c, x)
    _compress(x)


@njit(cache=True, error_model="numpy")
def _gather_inputs(s: Any, c: Any, x: Any) -> None:
    """Compute the inputs of a network of `ADAPTED_INPUTS`, or of the longer ones, which begin
    alike."""
    _gather(s.unit, s, c, x)
    at = _FIXED
    noise, common = s.fast_noise[0], s.fast_noise[1]
    x[at] = math.sqrt(s.background[0]) / noise
    x[at + 1] = math.sqrt(s.background[1]) / common
    x[at + 2] = math.sqrt(s.background[2]) / common
    x[at + 3] = math.sqrt(s.power[0] / (s.background[0] + noise * noise))
    # 10 mV is the order of a slip's impulse after a standard touch.
    x[at + 4] = 10.0 * s.unit / noise
    x[at + 5] = 1.0 if _has_touched(s) else 0.0
    if x.size > _ADAPTED:
        _gather_charges_and_commands(s, x)
    if x.size > _CHARGED:
        _gather_force(s, x)
    _compress(x)


@njit(cache=True, error_model="numpy")
def _gather_charges_and_commands(s: Any, x: Any) -> None:
    """Compute the inputs that `CHARGED_INPUTS` has after `ADAPTED_INPUTS`.

    The factors bring them to the order of 1 to 10, like the others.
    """
    at = _ADAPTED
    sign = 1.0 if s.average[0, 5] >= 0.0 else -1.0
    pressed = -1.0 if s.touch[1] > 0.0 else 1.0
    touch = STANDARD_TOUCH * s.touch_share
    d, v = sign * s.charge[0], pressed * s.charge[1]
    x[at] = 10.0 * d / touch
    x[at + 1] = 10.0 * v / touch
    # Pressing drives v_s negative: touch - v is the force in units of v_s.
    x[at + 2] = 10.0 * d / max(touch - v, 0.1 * touch)
    x[at + 3] = 3.0 * d / (s.long_peak[1] + 0.01 * touch)
    x[at + 4] = 3.0 * sign * s.average[0, 4] / (s.long_peak[0] + 0.3 * s.unit)
    x[at + 5] = 3.0 * s.peak[1] / (s.long_peak[2] + s.fast_noise[0])
    along = 1.0 if s.charge[0] >= 0.0 else -1.0
    for j in range(3):
        x[at + 6 + j] = 3.0 * along * s.average[0, 1 + j] / (s.long_peak[0] + 0.1 * s.unit)
    x[at + 9] = 2.0 * along * s.fast[0] / s.unit
    x[at + 10] = s.x_known
    x[at + 11] = abs(s.x_speed)
    x[at + 12] = s.x_braked
    x[at + 13] = s.x_started
    x[at + 14] = 0.0
    x[at + 15] = 0.0
    if s.x_known:
        x[at + 14] = sign * s.average[0, 3] / s.unit / (abs(s.x_speed) + 0.1)
    if abs(s.x_speed) > LEAST_SPEED_mm_s:
        expected = s.x_gain * abs(s.x_speed) + 0.1 * s.unit
        x[at + 15] = 3.0 * (1.0 - along * s.average[0, 2] / expected)


@njit(cache=True, error_model="numpy")
def _gather_force(s: Any, x: Any) -> None:
    """Compute the inputs that `INPUTS` has after `CHARGED_INPUTS`."""
    at = _CHARGED
    x[at] = s.force_known
    x[at + 1] = 10.0 * s.force_changes[0]
    x[at + 2] = 10.0 * s.force_changes[1]
    x[at + 3] = 0.0
    x[at + 4] = 0.0
    if s.force_known:
        sign = 1.0 if s.average[0, 5] >= 0.0 else -1.0
        x[at + 3] = 10.0 * (s.force_share - 1.0)
        touch = STANDARD_TOUCH * s.touch_share
        x[at + 4] = 10.0 * sign * s.charge[0] / (touch * max(s.force_share, 0.05))


@njit(cache=True, error_model="numpy")
def _gather(unit: float, s: Any, c: Any, x: Any) -> None:
    """Compute the inputs that all networks have, with voltages in units of `unit` times 0.5 mV."""
    sign = 1.0 if s.average[0, 5] >= 0.0 else -1.0
    pressed = -1.0 if s.touch[1] > 0.0 else 1.0
    mV = 2.0 / unit
    for j in range(_A):
        d, v = sign * s.average[0, j], pressed * s.average[1, j]
        if j + 1 < _A:
            d -= sign * s.average[0, j + 1]
            v -= pressed * s.average[1, j + 1]
        x[j] = mV * d
        x[_A + j] = mV * v
    at = 2 * _A
    noise, common = s.fast_noise[0], s.fast_noise[1]
    x[at] = mV * sign * s.fast[0]
    x[at + 1] = mV * pressed * s.fast[1]
    x[at + 2] = sign * s.fast[0] / noise
    for j in range(4):
        x[at + 3 + j] = mV * s.peak[j]
    x[at + 7] = s.peak[1] / noise
    x[at + 8] = math.sqrt(s.power[0]) / noise
    x[at + 9] = math.sqrt(s.power[1]) / noise
    x[at + 10] = math.sqrt(s.power[2]) / common
    x[at + 11] = 0.025 * mV * sign * s.sum[0]
    x[at + 12] = 0.025 * mV * pressed * s.sum[1]
    x[at + 13] = 0.025 * mV * sign * s.sum[2]
    x[at + 14] = 0.025 * mV * pressed * s.sum[3]
    x[at + 15] = mV * s.slow_peak[0]
    x[at + 16] = mV * s.slow_peak[1]
    # 0.3 mV, in units of the touch, keeps the ratio finite and small before anything happens.
    x[at + 17] = sign * s.average[0, 4] / (s.slow_peak[0] + 0.3 * unit)
    x[at + 18] = 2.0 * mV * s.noise[0]
    x[at + 19] = 2.0 * mV * s.noise[1]
    x[at + 20] = s.armed_rows / (10.0 * c.ms)


@njit(cache=True, error_model="numpy")
def _compress(x: Any) -> None:
    """Compress large numbers, so that none of them rules a weighted sum alone."""
    for i in range(x.size):
        # A loop of its own, so that the compiler can use vector instructions.
        x[i] = x[i] / math.sqrt(1.0 + abs(x[i]))


@njit(cache=True, error_model="numpy")
def _evaluate_network(x: Any, hidden: Any, output: Any, units: Any, s: Any) -> None:
    """Compute the probabilities of a slip now and of a roll under way."""
    inputs, n = x.size, units.size
    for u in range(n):
        units[u] = hidden[inputs, u]
    for i in range(inputs):
        for u in range(n):
            # The units are the inner loop because they do not depend on one another.
            units[u] += hidden[i, u] * x[i]
    odds_slip, odds_roll = output[0, n], output[1, n]
    for u in range(n):
        answer = units[u] / (1.0 + abs(units[u]))
        odds_slip += output[0, u] * answer
        odds_roll += output[1, u] * answer
    s.slip = 1.0 / (1.0 + math.exp(-odds_slip))
    s.roll = 1.0 / (1.0 + math.exp(-odds_roll))


@njit(cache=True, error_model="numpy")
def _decide(looks: bool, s: Any, c: Any, events: Any, reported: int) -> int:
    """Logic ``rig``: reports a slip or a roll that the network finds while armed, and what it
    rejects with the reason."""
    threshold = max(c.fire[0] * _unit(s, c), c.fire[1] * s.fast_noise[0])
    level = abs(s.fast[0])
    judges = s.unjudged == NO_REASON
    if level > threshold and judges and s.mute_rows == 0 and s.silent_rows == 0:
        if not s.armed:
            s.mute_rows = c.silent_rows
            confidence = level / (level + threshold)
            return _report(REJECTED, confidence, NOT_ARMED, level, threshold, s, events, reported)
        if s.suspect_rows == 0:
            s.suspect_rows = round(25.0 * c.ms)
            s.suspect[0], s.suspect[1], s.suspect[2] = level, threshold, s.peak[3]
            s.suspect[3] = 0.0
    silent_for = c.silent_rows - s.silent_rows
    if looks and s.slip < c.over_probability and silent_for >= c.least_silent_rows:
        s.silent_rows = 0
    enough = of_others = c.fire_probability[s.x_known]
    if not s.slip_reported:
        enough = max(enough, c.first_probability)
    if s.row < s.turning_until:
        enough = max(enough, c.turn_probability)
    if looks and s.slip > enough:
        s.suspect_rows = 0
        if s.silent_rows == 0:
            s.silent_rows = c.silent_rows
            s.slip_reported = 1
            return _report(SLIP, s.slip, NO_REASON, s.peak[0], threshold, s, events, reported)
        return reported
    if s.suspect_rows > 0:
        s.suspect[0] = max(s.suspect[0], level)
        s.suspect[2] = max(s.suspect[2], s.peak[3])
        if looks and s.slip > of_others:
            s.suspect[3] = max(s.suspect[3], s.slip)
        s.suspect_rows -= 1
        if s.suspect_rows == 0:
            s.mute_rows = c.silent_rows
            reason = UNLIKE
            confidence = 1.0 - s.slip
            if s.suspect[3] > 0.0:
                reason = NOT_SURE
                confidence = 1.0 - s.suspect[3]
            elif s.roll > 0.5:
                reason = IS_ROLL
            elif s.suspect[2] > s.suspect[0]:
                reason = COMMON
            return _report(
                REJECTED, confidence, reason, s.suspect[0], s.suspect[1], s, events, reported
            )
    moves = _has_touched(s) and s.moving_rows >= c.rolling_rows
    if looks and s.armed and moves and not s.roll_reported:
        s.roll_rows = s.roll_rows + 1 if s.roll > c.roll_probability else 0
        if s.roll_rows >= 4:
            s.roll_reported = 1
            return _report(ROLL, s.roll, NO_REASON, s.peak[0], threshold, s, events, reported)
    return reported


@njit(cache=True, error_model="numpy")
def _report(
    kind: int,
    confidence: float,
    reason: int,
    impulse: float,
    threshold: float,
    s: Any,
    events: Any,
    reported: int,
) -> int:
    row = events[reported]
    row[0], row[1], row[2], row[3] = kind, s.row, confidence, reason
    row[4] = s.low - s.offset[0]
    row[5], row[6], row[7] = impulse, s.peak[3], threshold
    row[8], row[9] = s.slip, s.roll
    row[10] = s.row - s.unjudged_from
    return reported + 1

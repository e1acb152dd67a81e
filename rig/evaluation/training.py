"""Trains the weights of the detector's network on labelled rows.

This is logistic regression through one hidden layer, by Adam (Kingma and Ba 2015) on shuffled
batches. All randomness comes from one seed: the same rows give the same weights on the same
machine. The targets are defined here too: the detector should report a slip once from 2 ms before
the whole ridge slips to 15 ms after it, again at each further slip, and never else; and, where the
commands are known, once more in every 0.1 s of a slip that lasts while x moves (decision 0125). An
alarm from 10 ms before to 30 ms after is right (decision 0079), so that the rows between are
neither taught as a slip nor as none. A partial slip is not a slip.

A slip is one case, not as many as it has rows. One alarm finds it, so what is taught is that the
probability is high at some of its rows: the odds of a slip are the mean of the odds of its rows.
The evidence comes early in one slip and late in another, and a network that is taught every row
alone learns to be cautious in all of them (decision 0124).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.evaluation.labelled_trials import LIFTS_WITHIN_S

Reals = NDArray[np.float64]
Singles = NDArray[np.float32]

EARLY_S, LATE_S = 0.002, 0.015
"""Interval around the slip of the whole ridge in which an alarm is taught. With an end at 25 ms the
median alarm came 2 ms later (decision 0126)."""
RIGHT_FROM_S, RIGHT_TO_S = 0.010, 0.030
"""Interval around it in which an alarm is right, and outside of which it is taught to be wrong."""
STICKS_FOR_S = 0.005
"""Time after the end of a slip from which an alarm is wrong again."""
BEFORE_LIFT_OFF_S = 0.01
"""Time before a lift-off from which nothing is taught; the slip of a ridge that is let go may come
earlier."""
ROLLING_FOR_S = 0.03
"""Time from the start of a roll after which the network should recognise it."""
SLIP_WEIGHT = 13.0
"""Weight of the first slip of a motion; a row without a slip has 1: about as many rows as a slip
has at 2 ms. Neither this nor the next was tuned (decision 0124)."""
FURTHER_SLIP = 0.12
"""Weight of each further slip, as a share of that: a trial in which the ridge slips fifty times
teaches seven times as much as one with a single slip, not fifty times."""
LASTING_S = 0.1
"""A slip that lasts while x moves is taught as one more case, as a further slip, in each of these
pieces of it: whoever answers an alarm by a firmer grip has to know that it was not enough (decision
0125)."""
LEAST_PIECE_S = 0.02
"""Length from which such a piece is taught."""
MOST_PIECES = 10
"""Number of these pieces in a trial up to which each weighs as much as a further slip. More of them
weigh together as much as these: a slide at 0.1 mm/s lasts for seconds (decision 0126)."""
BATCH, LEAST_STEPS = 32, 2000
"""Largest number of recordings in a batch; it is smaller where the training would have fewer steps
than the second."""


@dataclass(frozen=True)
class TrainingTrial:
    """Inputs of the network in one trial, and its truth. Times are in s, NaN where it did not
    happen."""

    inputs: Reals
    """Inputs of the network, (m, inputs)."""
    time_s: Reals
    """Time of each row, (m,)."""
    slips_s: Reals
    """Begin and end of every slip of the whole ridge, (k, 2)."""
    rolls: bool
    """True if the trial is a roll."""
    motion_s: float
    """Start of the motion."""
    motion_end_s: float
    """End of the roll; NaN if it lasts to the end, and for trials without a roll."""
    lift_off_s: float
    """Lift-off of the ridge."""
    moves: NDArray[np.bool_] | None = None
    """Rows at which x is known to be commanded to move, (m,); None where no commands are known, or
    not when slips end."""


@dataclass(frozen=True)
class TrainingRows:
    """Rows on which the network is trained, with targets and weights for slip and roll."""

    inputs: Singles
    """Inputs of the network, (m, inputs)."""
    right: Singles
    """Targets (m, 2): 1 where it should report slip, roll."""
    weight: Singles
    """Weights (m, 2): 0 where its answer is not used. All rows of a slip have the weight of the
    slip, which is one case."""
    slip: NDArray[np.int64]
    """Number of the slip of which a row is one, from 0, and -1 for rows of no slip, (m,)."""


def rows_of(lesson: TrainingTrial) -> TrainingRows:
    """Return the training rows of a trial."""
    time = lesson.time_s
    right = np.zeros((time.size, 2), np.float32)
    weight = np.ones((time.size, 2), np.float32)
    moving = time > lesson.motion_s
    if lesson.rolls:
        right[:, 1] = moving
        weight[moving & (time < lesson.motion_s + ROLLING_FOR_S), 1] = 0
        weight[time > lesson.motion_end_s, 1] = 0
    slips_s = lesson.slips_s[lesson.slips_s[:, 0] >= lesson.motion_s]
    # What is open first, then what is taught: two slips may follow one another closely.
    for begin_s, end_s in slips_s:
        ends_s = max(end_s + STICKS_FOR_S, begin_s + RIGHT_TO_S)
        weight[(time > begin_s - RIGHT_FROM_S) & (time < ends_s), 0] = 0
        weight[time > begin_s, 1] = 0
    slip = np.full(time.size, -1)
    for number, (begin_s, _) in enumerate(slips_s):
        taught = (time >= begin_s - EARLY_S) & (time <= begin_s + LATE_S)
        right[taught, 0] = 1
        # An alarm in the time of two slips finds both. These rows are the earlier slip's; what is
        # left of the later one is a case of its own.
        taught &= slip < 0
        weight[taught, 0] = SLIP_WEIGHT * (FURTHER_SLIP if number else 1.0)
        slip[taught] = number
    if lesson.moves is not None:
        lasting = _pieces_of_lasting_slips(time, slips_s, lesson.moves & (slip < 0))
        at = lasting >= 0
        share = min(1.0, MOST_PIECES / max(np.unique(lasting[at]).size, 1))
        right[at, 0] = 1
        weight[at, 0] = SLIP_WEIGHT * FURTHER_SLIP * share
        slip[at] = len(slips_s) + lasting[at]
    if math.isfinite(lesson.lift_off_s):
        let_go_s = lesson.lift_off_s - BEFORE_LIFT_OFF_S
        late = slips_s[slips_s[:, 0] > lesson.lift_off_s - LIFTS_WITHIN_S, 0]
        unclear = time > min([let_go_s, *(late - RIGHT_FROM_S)])
        right[unclear], weight[unclear], slip[unclear] = 0, 0, -1
    return TrainingRows(lesson.inputs.astype(np.float32), right, weight, slip)


def _pieces_of_lasting_slips(
    time_s: Reals, slips_s: Reals, usable: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the number of the piece of a lasting slip of which a row at `time_s` (m,) is one, -1
    for the others; `usable` (m,) are the rows that may be one."""
    numbers, count = np.full(time_s.size, -1), 0
    row_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0
    for begin_s, end_s in slips_s:
        lasts_from_s = begin_s + RIGHT_TO_S
        lasts = usable & (time_s > lasts_from_s) & (time_s < end_s) & (numbers < 0)
        pieces = ((time_s[lasts] - lasts_from_s) // LASTING_S).astype(np.int64)
        rows = np.bincount(pieces)
        long_enough = rows * row_s >= LEAST_PIECE_S
        numbers[lasts] = np.where(long_enough[pieces], count + pieces, -1)
        count += rows.size
    return numbers


def learn_together(
    recordings: Sequence[TrainingRows],
    members: int,
    units: int,
    epochs: int,
    seed: int,
    on_epoch: Callable[[int, float], None] | None = None,
) -> tuple[Reals, Reals]:
    """Return the weights of `members` networks that were trained apart, as one network.

    Its log odds are the mean of theirs, so that what one of them has learnt by chance counts less.
    It has `members` times `units` hidden units.
    """
    parts = [learn(recordings, units, epochs, seed + member, on_epoch) for member in range(members)]
    hidden = np.vstack([one for one, _ in parts])
    spread = [one[:, :-1] / members for _, one in parts]
    bias = np.mean([one[:, -1] for _, one in parts], axis=0)
    return hidden, np.column_stack([*spread, bias])


def learn(
    recordings: Sequence[TrainingRows],
    units: int = 16,
    epochs: int = 30,
    seed: int = 0,
    on_epoch: Callable[[int, float], None] | None = None,
) -> tuple[Reals, Reals]:
    """Return hidden weights (units, inputs + 1) and output weights (2, units + 1).

    `on_epoch` is called with the number and the mean loss of every epoch. Inputs are scaled during
    training; the returned weights apply to the inputs as they are.
    """
    chance = np.random.default_rng(seed)
    recordings = [one for one in recordings if len(one.inputs)]
    middle, spread = _scale(recordings)
    # Scaled inputs let one learning rate suit all of them; the scale is folded into the weights
    # below.
    scaled = [replace(one, inputs=(one.inputs - middle) / spread) for one in recordings]
    inputs = middle.size
    weights = [
        chance.standard_normal((units, inputs)).astype(np.float32) / math.sqrt(inputs),
        np.zeros(units, np.float32),
        chance.standard_normal((2, units)).astype(np.float32) / math.sqrt(units),
        # Slips and rolls are rare: the biases start at low odds, not at one half.
        np.full(2, -3.0, np.float32),
    ]
    first = [np.zeros_like(w) for w in weights]
    second = [np.zeros_like(w) for w in weights]
    size = min(BATCH, max(1, len(recordings) * epochs // LEAST_STEPS))
    count, steps = math.ceil(len(recordings) / size), 0
    for epoch in range(epochs):
        order = chance.permutation(len(recordings))
        losses = 0.0
        for begin in range(0, len(order), size):
            at = order[begin : begin + size]
            # One recording at a time, whose rows stay in the processor's cache: as one array those
            # of a batch took 1.8 times as long.
            rows = sum(len(recordings[k].inputs) for k in at)
            loss, slopes = 0.0, [np.zeros_like(w) for w in weights]
            for k in at:
                of_one, its_slopes = _slopes(scaled[k], weights)
                loss += of_one / rows
                for sum_of, slope in zip(slopes, its_slopes, strict=True):
                    sum_of += slope / np.float32(rows)
            losses += loss
            steps += 1
            rate = 0.004 * 0.5 * (1 + math.cos(math.pi * steps / (epochs * count)))
            for w, m, v, g in zip(weights, first, second, slopes, strict=True):
                m += 0.1 * (g - m)
                v += 0.001 * (g * g - v)
                fair = rate * math.sqrt(1 - 0.999**steps) / (1 - 0.9**steps)
                w -= fair * m / (np.sqrt(v) + 1e-8)
        if on_epoch is not None:
            on_epoch(epoch, losses / count)
    into, bias, out, out_bias = (w.astype(np.float64) for w in weights)
    plain = into / spread
    hidden = np.column_stack([plain, bias - plain @ middle])
    return hidden, np.column_stack([out, out_bias])


def _scale(recordings: Sequence[TrainingRows]) -> tuple[Singles, Singles]:
    """Return mean and standard deviation of the inputs over all rows."""
    count = sum(len(one.inputs) for one in recordings)
    sums = [one.inputs.sum(axis=0, dtype=np.float64) for one in recordings]
    middle = np.sum(sums, axis=0) / count
    squares = [((one.inputs - middle) ** 2).sum(axis=0) for one in recordings]
    spread = np.sqrt(np.sum(squares, axis=0) / count) + 1e-6
    return middle.astype(np.float32), spread.astype(np.float32)


def _slopes(rows: TrainingRows, weights: list[Singles]) -> tuple[float, list[Singles]]:
    """Return the loss of a recording, summed over its rows, with its derivatives with respect to
    the weights. Its inputs are scaled already."""
    into, bias, out, out_bias = weights
    total = rows.inputs @ into.T + bias
    flatness = 1 / (1 + np.abs(total))
    answer = total * flatness
    odds = answer @ out.T + out_bias
    said = 1 / (1 + np.exp(-odds))
    loss = rows.weight * (np.logaddexp(0, odds) - rows.right * odds)
    error = rows.weight * (said - rows.right)
    at = np.flatnonzero(rows.slip >= 0)
    if at.size:
        loss[at, 0], error[at, 0] = _of_slips(odds[at, 0], rows.slip[at], rows.weight[at, 0])
    back = (error @ out) * flatness**2
    return float(loss.sum()), [
        back.T @ rows.inputs,
        back.sum(axis=0),
        error.T @ answer,
        error.sum(axis=0),
    ]


def _of_slips(odds: Singles, slip: NDArray[np.int64], weight: Singles) -> tuple[Singles, Singles]:
    """Return the loss of rows of slips and its derivatives with respect to their log odds.

    The odds of a slip are the mean of the odds of its rows. Its loss is shared by them in
    proportion to their odds.
    """
    _, number = np.unique(slip, return_inverse=True)
    highest = np.full(number.max() + 1, -np.inf, np.float32)
    np.maximum.at(highest, number, odds)
    above = np.exp(odds - highest[number])
    sums, rows = np.bincount(number, above), np.bincount(number)
    pooled = highest + np.log(sums / rows)
    share = above / sums[number]
    missed = 1 / (1 + np.exp(pooled))
    loss = (np.logaddexp(0, -pooled))[number] * share * weight
    return loss.astype(np.float32), (-missed[number] * share * weight).astype(np.float32)

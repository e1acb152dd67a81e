"""Trains the weights of the detector's network on labelled rows.

This is plain logistic regression through one hidden layer, by Adam (Kingma and Ba 2015) on shuffled
batches. All randomness comes from one seed: the same rows give the same weights on the same
machine. The targets are defined here too: the detector should report a slip from 2 ms before the
whole ridge slips to 25 ms after it. A partial slip is not a slip.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Singles = NDArray[np.float32]

EARLY_S, LATE_S = 0.002, 0.025
"""Interval around the slip of the whole ridge in which an alarm is right."""
UNDECIDED_S = 0.008
"""Length of the interval before it in which an alarm is neither right nor wrong."""
BEFORE_LIFT_OFF_S = 0.01
"""Time before a lift-off, or a slip, from which the rows of a roll are not used."""
ROLLING_FOR_S = 0.03
"""Time from the start of a roll after which the network should recognise it."""


@dataclass(frozen=True)
class TrainingTrial:
    """Inputs of the network in one trial, and its truth. Times are in s, NaN where it did not
    happen."""

    inputs: Reals
    """Inputs of the network, (m, inputs)."""
    time_s: Reals
    """Time of each row, (m,)."""
    rolls: bool
    """True if the trial is a roll."""
    motion_s: float
    """Start of the motion."""
    ridge_slip_s: float
    """Slip of the whole ridge."""
    lift_off_s: float
    """Lift-off of the ridge."""


@dataclass(frozen=True)
class TrainingRows:
    """Rows on which the network is trained, with targets and weights for slip and roll."""

    inputs: Singles
    """Inputs of the network, (m, inputs)."""
    right: Singles
    """Targets (m, 2): 1 where it should report slip, roll."""
    weight: Singles
    """Weights (m, 2): 0 where its answer is not used."""


def rows_of(lesson: TrainingTrial) -> TrainingRows:
    """Returns the training rows of a trial."""
    time, slip = lesson.time_s, lesson.ridge_slip_s
    right = np.zeros((time.size, 2), np.float32)
    weight = np.ones((time.size, 2), np.float32)
    if lesson.rolls:
        end = np.fmin(np.fmin(lesson.lift_off_s, slip), math.inf) - BEFORE_LIFT_OFF_S
        weight[time > end] = 0
        moving = time > lesson.motion_s
        right[:, 1] = moving
        weight[moving & (time < lesson.motion_s + ROLLING_FOR_S), 1] = 0
    elif math.isfinite(slip):
        right[:, 0] = (time >= slip - EARLY_S) & (time <= slip + LATE_S)
        undecided = (time > slip - EARLY_S - UNDECIDED_S) & (time < slip - EARLY_S)
        weight[undecided | (time > slip + LATE_S), 0] = 0
        weight[time > slip, 1] = 0
    return TrainingRows(lesson.inputs.astype(np.float32), right, weight)


def learn(
    rows: TrainingRows,
    units: int = 24,
    epochs: int = 30,
    seed: int = 0,
    on_epoch: Callable[[int, float], None] | None = None,
) -> tuple[Reals, Reals]:
    """Returns hidden weights (units, inputs + 1) and output weights (2, units + 1).

    `on_epoch` is called with the number and the mean loss of every epoch. Inputs are scaled during
    training; the returned weights apply to the inputs as they are.
    """
    chance = np.random.default_rng(seed)
    count, inputs = rows.inputs.shape
    middle = rows.inputs.mean(axis=0)
    spread = rows.inputs.std(axis=0) + 1e-6
    # Scaled inputs let one learning rate suit all of them; the scale is folded into the weights
    # below.
    x = (rows.inputs - middle) / spread
    weights = [
        chance.standard_normal((units, inputs)).astype(np.float32) / math.sqrt(inputs),
        np.zeros(units, np.float32),
        chance.standard_normal((2, units)).astype(np.float32) / math.sqrt(units),
        # Slips and rolls are rare: the biases start at low odds, not at one half.
        np.full(2, -3.0, np.float32),
    ]
    first = [np.zeros_like(w) for w in weights]
    second = [np.zeros_like(w) for w in weights]
    batch, steps = 2048, 0
    total = epochs * math.ceil(count / batch)
    for epoch in range(epochs):
        order = chance.permutation(count)
        losses = 0.0
        for begin in range(0, count, batch):
            at = order[begin : begin + batch]
            loss, slopes = _slopes(x[at], rows.right[at], rows.weight[at], weights)
            losses += loss
            steps += 1
            rate = 0.004 * 0.5 * (1 + math.cos(math.pi * steps / total))
            for w, m, v, g in zip(weights, first, second, slopes, strict=True):
                m += 0.1 * (g - m)
                v += 0.001 * (g * g - v)
                fair = rate * math.sqrt(1 - 0.999**steps) / (1 - 0.9**steps)
                w -= fair * m / (np.sqrt(v) + 1e-8)
        if on_epoch is not None:
            on_epoch(epoch, losses / math.ceil(count / batch))
    into, bias, out, out_bias = (w.astype(np.float64) for w in weights)
    plain = into / spread
    hidden = np.column_stack([plain, bias - plain @ middle])
    return hidden, np.column_stack([out, out_bias])


def _slopes(
    x: Singles, right: Singles, weight: Singles, weights: list[Singles]
) -> tuple[float, list[Singles]]:
    """Returns the mean loss of a batch and its derivatives with respect to the weights."""
    into, bias, out, out_bias = weights
    total = x @ into.T + bias
    answer = total / (1 + np.abs(total))
    odds = answer @ out.T + out_bias
    said = 1 / (1 + np.exp(-odds))
    loss = weight * (np.logaddexp(0, odds) - right * odds)
    error = weight * (said - right) / len(x)
    back = (error @ out) * (1 - np.abs(answer)) ** 2
    return float(loss.sum() / len(x)), [
        back.T @ x,
        back.sum(axis=0),
        error.T @ answer,
        error.sum(axis=0),
    ]

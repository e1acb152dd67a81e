"""Learning the detector's network: what is right, what counts, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest

from rig.evaluation import training
from rig.evaluation.training import (
    FURTHER_SLIP,
    MOST_PIECES,
    SLIP_WEIGHT,
    TrainingRows,
    TrainingTrial,
    learn,
    learn_together,
    rows_of,
)

NEVER = float("nan")
NONE = np.zeros((0, 2))


def lesson(**changes: object) -> TrainingTrial:
    """A row every millisecond for a second; a slide that slips at 0.8 s unless another is given."""
    values = {
        "inputs": np.zeros((1000, 3)),
        "time_s": np.arange(1000) / 1000,
        "slips_s": np.array([[0.8, 1.0]]),
        "rolls": False,
        "motion_s": 0.5,
        "motion_end_s": NEVER,
        "lift_off_s": NEVER,
    }
    return TrainingTrial(**(values | changes))  # type: ignore[arg-type]


def test_a_slip_is_right_around_the_whole_ridges_slip_only():
    rows = rows_of(lesson())
    right = np.flatnonzero(rows.right[:, 0])
    assert (right.min(), right.max()) == (798, 815)
    counted = np.flatnonzero(rows.weight[:, 0])
    assert set(counted) == set(range(791)) | set(range(798, 816))


def test_a_second_slip_is_as_right_as_the_first_and_what_is_between_them_is_wrong():
    rows = rows_of(lesson(slips_s=np.array([[0.6, 0.6495], [0.8, 0.8195]])))
    right = set(np.flatnonzero(rows.right[:, 0]))
    assert right == set(range(598, 616)) | set(range(798, 816))
    wrong = set(np.flatnonzero((rows.right[:, 0] == 0) & (rows.weight[:, 0] == 1)))
    assert wrong == set(range(591)) | set(range(655, 791)) | set(range(831, 1000))
    assert not rows.right[:, 1].any()


def test_a_slip_is_one_case_and_the_first_of_a_motion_teaches_most():
    rows = rows_of(lesson(slips_s=np.array([[0.4, 0.41], [0.6, 0.64], [0.61, 0.7], [0.8, 0.9]])))
    # That before the motion is none; the second one here has what the first one leaves it.
    assert [list(np.flatnonzero(rows.slip == k)) for k in (0, 1, 2)] == [
        list(range(598, 616)), list(range(616, 626)), list(range(798, 816))
    ]  # fmt: skip
    assert (rows.slip >= 0).sum() == rows.right[:, 0].sum()
    weights = [set(rows.weight[rows.slip == k, 0]) for k in (0, 1, 2)]
    further = np.float32(SLIP_WEIGHT * FURTHER_SLIP)
    assert weights == [{np.float32(SLIP_WEIGHT)}, {further}, {further}]
    no = rows.slip < 0
    assert set(rows.weight[no, 0]) == {0, 1}


def test_a_slip_that_lasts_while_x_moves_is_a_case_in_every_100_ms():
    moves = np.arange(1000) < 905
    slips_s = np.array([[0.6, 0.61], [0.6505, 0.99]])
    rows = rows_of(lesson(slips_s=slips_s, moves=moves))
    assert [list(np.flatnonzero(rows.slip == k)) for k in range(5)] == [
        list(range(598, 616)), list(range(649, 666)),
        list(range(681, 781)), list(range(781, 881)), list(range(881, 905)),
    ]  # fmt: skip
    assert set(rows.weight[rows.slip > 1, 0]) == {np.float32(SLIP_WEIGHT * FURTHER_SLIP)}
    assert (rows.right[:, 0] == (rows.slip >= 0)).all()
    assert not rows.weight[905:995, 0].any()  # x stands: nothing is taught until the slip is over
    unknown = rows_of(lesson(slips_s=slips_s))
    assert not unknown.weight[666:995, 0].any()


def test_a_short_remainder_of_a_lasting_slip_is_not_taught():
    moves = np.arange(1000) < 895  # 14 ms after the second piece
    rows = rows_of(lesson(slips_s=np.array([[0.6505, 0.99]]), moves=moves))
    assert rows.slip.max() == 2
    assert not rows.weight[881:995, 0].any()


def test_a_slip_of_many_pieces_weighs_as_much_as_one_of_ten():
    long = replace(lesson(), time_s=np.arange(3000) / 1000, inputs=np.zeros((3000, 3)))
    slips_s, moves = np.array([[0.52, 2.9]]), np.ones(3000, bool)
    rows = rows_of(replace(long, slips_s=slips_s, moves=moves))
    pieces = np.unique(rows.slip[rows.slip > 0])
    assert len(pieces) == 24
    share = MOST_PIECES / len(pieces)
    assert rows.weight[rows.slip > 0, 0] == pytest.approx(SLIP_WEIGHT * FURTHER_SLIP * share)


def test_a_hold_teaches_no_slip_at_all():
    rows = rows_of(lesson(slips_s=NONE))
    assert not rows.right.any()
    assert rows.weight.all()


def test_a_roll_is_right_from_its_motion_on_and_counts_a_little_later():
    rows = rows_of(lesson(rolls=True, slips_s=NONE))
    assert list(np.flatnonzero(rows.right[:, 1])) == list(range(501, 1000))
    assert list(np.flatnonzero(rows.weight[:, 1] == 0)) == list(range(501, 530))


def test_nothing_counts_from_shortly_before_a_ridge_lifts_off():
    rows = rows_of(lesson(rolls=True, slips_s=NONE, lift_off_s=0.7))
    assert rows.weight[:691].any(axis=1).all()
    assert not rows.weight[691:].any()
    with_slip = rows_of(lesson(rolls=True, slips_s=np.array([[0.65, 0.7]]), lift_off_s=0.7))
    assert not with_slip.weight[641:].any()
    assert not with_slip.right[:, 0].any()


def test_a_roll_teaches_nothing_of_rolls_after_its_end():
    rows = rows_of(lesson(rolls=True, slips_s=NONE, motion_end_s=0.9))
    assert list(np.flatnonzero(rows.weight[530:, 1] == 0) + 530) == list(range(901, 1000))


def plain_problem() -> TrainingRows:
    """Slip where the first input exceeds the second, roll inside a ring: not linear."""
    chance = np.random.default_rng(5)
    x = chance.standard_normal((6000, 3)).astype(np.float32) * (1, 5, 1) + (0, 20, 0)
    first = x[:, 0] > (x[:, 1] - 20) / 5
    ring = np.hypot(x[:, 0], x[:, 2]) < 1.0
    right = np.column_stack([first, ring]).astype(np.float32)
    return TrainingRows(x.astype(np.float32), right, np.ones_like(right), np.full(6000, -1))


def in_recordings(rows: TrainingRows) -> list[TrainingRows]:
    """Cut rows into recordings of 60, of which none has a slip of several rows."""
    cuts = [slice(begin, begin + 60) for begin in range(0, len(rows.inputs), 60)]
    return [
        TrainingRows(rows.inputs[at], rows.right[at], rows.weight[at], rows.slip[at]) for at in cuts
    ]


def answers(rows: TrainingRows, hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
    total = rows.inputs @ hidden[:, :-1].T + hidden[:, -1]
    return (total / (1 + np.abs(total))) @ output[:, :-1].T + output[:, -1] > 0


@pytest.mark.thorough
def test_it_learns_what_can_be_learned():
    rows = plain_problem()
    losses: list[float] = []
    hidden, output = learn(
        in_recordings(rows), units=12, epochs=800, seed=1,
        on_epoch=lambda _, loss: losses.append(loss),
    )  # fmt: skip
    assert (answers(rows, hidden, output) == rows.right).mean(axis=0) == pytest.approx(1, abs=0.05)
    assert len(losses) == 800
    assert losses[-1] < losses[0] / 4


def test_the_seed_decides_everything():
    rows = in_recordings(plain_problem())
    one, other = (learn(rows, units=4, epochs=2, seed=3) for _ in range(2))
    assert (one[0] == other[0]).all()
    assert (one[1] == other[1]).all()
    assert (learn(rows, units=4, epochs=2, seed=4)[0] != one[0]).any()


def test_networks_that_are_averaged_answer_with_the_mean_of_their_log_odds():
    rows = plain_problem()

    def odds(hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
        total = rows.inputs @ hidden[:, :-1].T + hidden[:, -1]
        return (total / (1 + np.abs(total))) @ output[:, :-1].T + output[:, -1]

    cut = in_recordings(rows)
    apart = [odds(*learn(cut, units=3, epochs=1, seed=seed)) for seed in (5, 6)]
    together = odds(*learn_together(cut, members=2, units=3, epochs=1, seed=5))
    assert together == pytest.approx((apart[0] + apart[1]) / 2, abs=1e-4)
    assert np.abs(apart[0] - apart[1]).max() > 0.1


@pytest.mark.thorough
def test_rows_that_do_not_count_teach_nothing():
    rows = plain_problem()
    spoilt = TrainingRows(rows.inputs, rows.right.copy(), rows.weight.copy(), rows.slip)
    spoilt.right[::2] = 1 - spoilt.right[::2]
    spoilt.weight[::2] = 0
    hidden, output = learn(in_recordings(spoilt), units=12, epochs=400, seed=1)
    assert (answers(rows, hidden, output) == rows.right).mean() > 0.93


@pytest.mark.thorough
def test_what_is_taught_of_a_slip_is_that_some_of_its_rows_say_so():
    """The evidence comes at one row of each slip, early or late; the others look like a hold."""
    chance = np.random.default_rng(7)

    def recording() -> TrainingRows:
        x = 0.1 * chance.standard_normal((200, 2)).astype(np.float32)
        slip = np.full(200, -1)
        slip[100:120] = 0
        x[chance.integers(100, 120), 0] = 2.0
        right, weight = np.zeros((200, 2), np.float32), np.ones((200, 2), np.float32)
        right[slip == 0, 0], weight[slip == 0, 0] = 1, SLIP_WEIGHT
        return TrainingRows(x, right, weight, slip)

    hidden, output = learn([recording() for _ in range(64)], units=4, epochs=200, seed=2)

    def odds(x: list[float]) -> float:
        total = hidden[:, :-1] @ x + hidden[:, -1]
        return float((output[:, :-1] @ (total / (1 + np.abs(total))) + output[:, -1])[0])

    assert odds([2.0, 0.0]) > 2
    assert odds([0.0, 0.0]) < -4


def test_the_derivatives_are_those_of_the_loss():
    chance = np.random.default_rng(3)
    x = chance.standard_normal((40, 3))
    right = (chance.random((40, 2)) < 0.3).astype(float)
    slip = np.full(40, -1)
    slip[5:12], slip[12:15], slip[14] = 0, 1, 0
    right[slip >= 0, 0] = 1
    rows = TrainingRows(x, right, chance.random((40, 2)), slip)
    for number in (0, 1):  # the rows of a slip share one weight
        rows.weight[slip == number, 0] = rows.weight[slip == number, 0][0]
    weights = [chance.standard_normal(shape) for shape in ((4, 3), 4, (2, 4), 2)]
    _, slopes = training._slopes(rows, weights)
    for one, slope in zip(weights, slopes, strict=True):
        at = tuple(0 for _ in one.shape)
        was = one[at]
        losses = []
        for moved in (-1e-4, 1e-4):
            one[at] = was + moved
            losses.append(training._slopes(rows, weights)[0])
        one[at] = was
        assert slope[at] == pytest.approx((losses[1] - losses[0]) / 2e-4, rel=0.02, abs=1e-4)

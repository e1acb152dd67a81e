"""Learning the detector's network: what is right, what counts, and that it learns."""

import numpy as np
import pytest

from rig.evaluation.training import TrainingRows, TrainingTrial, learn, learn_together, rows_of

NEVER = float("nan")
NONE = np.zeros((0, 2))


def lesson(**changes: object) -> TrainingTrial:
    """A row every millisecond for a second; a slide that slips at 0.8 s unless told otherwise."""
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
    assert (right.min(), right.max()) == (798, 825)
    counted = np.flatnonzero(rows.weight[:, 0])
    assert set(counted) == set(range(791)) | set(range(798, 826))


def test_a_second_slip_is_as_right_as_the_first_and_what_is_between_them_is_wrong():
    rows = rows_of(lesson(slips_s=np.array([[0.6, 0.6495], [0.8, 0.8195]])))
    right = set(np.flatnonzero(rows.right[:, 0]))
    assert right == set(range(598, 626)) | set(range(798, 826))
    wrong = set(np.flatnonzero((rows.right[:, 0] == 0) & (rows.weight[:, 0] == 1)))
    assert wrong == set(range(591)) | set(range(655, 791)) | set(range(831, 1000))
    assert not rows.right[:, 1].any()


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
    return TrainingRows(x.astype(np.float32), right, np.ones_like(right))


def answers(rows: TrainingRows, hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
    total = rows.inputs @ hidden[:, :-1].T + hidden[:, -1]
    return (total / (1 + np.abs(total))) @ output[:, :-1].T + output[:, -1] > 0


def test_it_learns_what_can_be_learned():
    rows = plain_problem()
    losses: list[float] = []
    hidden, output = learn(
        rows, units=12, epochs=400, seed=1, on_epoch=lambda _, loss: losses.append(loss)
    )
    assert (answers(rows, hidden, output) == rows.right).mean(axis=0) == pytest.approx(1, abs=0.05)
    assert len(losses) == 400
    assert losses[-1] < losses[0] / 4


def test_the_seed_decides_everything():
    rows = plain_problem()
    one, other = (learn(rows, units=4, epochs=2, seed=3) for _ in range(2))
    assert (one[0] == other[0]).all()
    assert (one[1] == other[1]).all()
    assert (learn(rows, units=4, epochs=2, seed=4)[0] != one[0]).any()


def test_networks_that_are_averaged_answer_with_the_mean_of_their_log_odds():
    rows = plain_problem()

    def odds(hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
        total = rows.inputs @ hidden[:, :-1].T + hidden[:, -1]
        return (total / (1 + np.abs(total))) @ output[:, :-1].T + output[:, -1]

    apart = [odds(*learn(rows, units=3, epochs=1, seed=seed)) for seed in (5, 6)]
    together = odds(*learn_together(rows, members=2, units=3, epochs=1, seed=5))
    assert together == pytest.approx((apart[0] + apart[1]) / 2, abs=1e-4)
    assert np.abs(apart[0] - apart[1]).max() > 0.1


def test_rows_that_do_not_count_teach_nothing():
    rows = plain_problem()
    spoilt = TrainingRows(rows.inputs, rows.right.copy(), rows.weight.copy())
    spoilt.right[::2] = 1 - spoilt.right[::2]
    spoilt.weight[::2] = 0
    hidden, output = learn(spoilt, units=12, epochs=400, seed=1)
    assert (answers(rows, hidden, output) == rows.right).mean() > 0.93

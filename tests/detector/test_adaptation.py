"""The detector `rig` with a network of today's inputs: from the first touch on it knows gain and
noise, without waiting for quiet.

The network here has one unit by hand, so that what is tested is the kernel and not the training: a
slip is an impulse above a share of the touch, and every motion is a roll.
"""

import inspect
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.detector import kernel
from rig.detector.detector import IncipientSlipDetector
from rig.detector.events import SlipEvent, unjudged_s
from rig.detector.network import Network
from rig.detector.notices import HeldForce, XMove
from rig.detector.settings import DetectorSettings, RigSettings, named_detectors

RATE_Hz = 1000.0
IMPULSE = "peak of v_d 3 ms"


def by_hand(threshold: float = 2.0, roll_odds: float = -50.0) -> DetectorSettings:
    """A network that reports a slip where the compressed impulse is above a threshold, and a roll
    with odds that do not depend on its inputs."""
    hidden = [40.0 if name == IMPULSE else 0.0 for name in kernel.INPUTS]
    network = Network(
        name="by hand",
        inputs=kernel.INPUTS,
        hidden=((*hidden, -40.0 * threshold),),
        output=((50.0, 0.0), (0.0, roll_odds)),
        first_seed=0,
        last_seed=0,
        trained_by="hand",
    )
    return DetectorSettings(network=network)


def pressed_and_sheared(seed: int = 0, noise_mV: float = 0.1) -> np.ndarray:
    """Volts (2200, 2): a press of 0.3 s to 4 N, rest, a shear from 1.2 s that ends in an impulse at
    1.5 s, rest."""
    time = np.arange(2200) / RATE_Hz
    press = np.where((time > 0.3) & (time < 0.6), -4.5 * np.sin(np.pi * (time - 0.3) / 0.3), 0.0)
    hump = 3.0 * np.clip((time - 1.2) / 0.05, 0, 1) * (time < 1.5)
    v_d = 0.1 * press + hump - 30.0 * np.exp(-(((time - 1.5) / 0.0012) ** 2))
    noise = noise_mV * np.random.default_rng(seed).standard_normal((2200, 2))
    return 1e-3 * (np.column_stack([press + v_d / 2, press - v_d / 2]) + noise)


def reported(volts: np.ndarray, chosen: DetectorSettings | None = None) -> list[SlipEvent]:
    detector = IncipientSlipDetector(chosen or by_hand(), RATE_Hz)
    return detector.add(volts) + detector.finish()


def samples(events: list[SlipEvent], kind: str = "incipient slip") -> list[int]:
    return [event.sample for event in events if event.kind == kind]


def drifting(volts: np.ndarray) -> np.ndarray:
    """Adds the drift of a film that warms: 6 mV that decay within 4 s, unequal by a fifth."""
    time = np.arange(len(volts)) / RATE_Hz
    return volts + 6e-3 * np.exp(-time / 4)[:, None] * np.array([1.0, 0.8])


def restless(volts: np.ndarray) -> np.ndarray:
    """Adds a stage that shakes both strips at 31 Hz, from the first row on."""
    time = np.arange(len(volts)) / RATE_Hz
    shaking = 1.5e-3 * np.sin(2 * np.pi * 31 * time) * (1 + 0.6 * np.sin(2 * np.pi * 2 * time))
    return volts + shaking[:, None]


def bursting(volts: np.ndarray) -> np.ndarray:
    """Adds a burst of 15 ms every 0.2 s to both channels alike."""
    time = np.arange(len(volts)) / RATE_Hz
    burst = 20e-3 * np.sin(2 * np.pi * 180 * time) * (time % 0.2 < 0.015)
    return volts + burst[:, None]


@pytest.mark.parametrize("spoilt", [drifting, restless, bursting])
def test_a_recording_that_is_never_quiet_is_judged(spoilt):
    volts = spoilt(pressed_and_sheared())
    paper = IncipientSlipDetector(DetectorSettings(logic="paper-hp"), RATE_Hz)
    begin = [event.kind for event in paper.add(volts[:1100])]
    assert "cannot judge" in begin or spoilt is not bursting
    events = reported(volts)
    assert unjudged_s(events, 2.2) == ()
    (slip,) = samples(events)
    assert 1498 <= slip <= 1504


@pytest.mark.parametrize("gain", [0.2, 0.25, 0.5, 3.0])
def test_the_gain_of_the_amplifiers_makes_no_difference(gain: float):
    volts = pressed_and_sheared(1)
    assert samples(reported(gain * volts)) == samples(reported(volts)) != []
    looks = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(volts)
    changed = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(gain * volts)
    rows = np.intersect1d(looks.rows, changed.rows)
    rows = rows[rows > 800]  # the touch-down is over
    here, there = np.isin(looks.rows, rows), np.isin(changed.rows, rows)
    at = kernel.INPUTS.index(IMPULSE)
    assert rows.size > 100
    np.testing.assert_allclose(changed.inputs[there, at], looks.inputs[here, at], rtol=0.03)


@pytest.mark.parametrize("gain", [0.25, 1.0, 3.0])
def test_the_sums_since_the_touch_are_shear_and_force_in_units_of_the_touch(gain: float):
    """The press sums to 1719 mV ms. v_d rises within 50 ms to 3 mV, stays for 0.25 s, and the
    impulse takes 64 mV ms back."""
    shown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(gain * pressed_and_sheared(5))

    def at(row: int, name: str) -> float:
        (compressed,) = shown.inputs[shown.rows == row, kernel.INPUTS.index(name)]
        return compressed * (abs(compressed) + math.sqrt(compressed**2 + 4)) / 2

    before = max(row for row in shown.rows if row < 1490)
    after = max(row for row in shown.rows if row < 1530)
    shear = 3.0 * (before - 1225) / 1719
    touch, force = (
        "sum of v_d since the touch to the touch",
        "sum of v_d since the touch to the force",
    )
    assert at(before, touch) == pytest.approx(10 * shear, rel=0.06)
    assert at(before, force) == pytest.approx(at(before, touch), rel=0.06)
    # Its offset is a mean over 16 ms, in which a little of the press is left: 0.03 mV for 0.7 s are
    # 1.5 % of the touch.
    assert abs(at(before, "sum of v_s since the touch to the touch")) < 0.7
    whole = 3.0 * (1500 - 1225)
    assert at(after, touch) == pytest.approx(10 * (whole - 64) / 1719, rel=0.08)
    to_peak = "sum of v_d since the touch to its long peak"
    assert at(before, to_peak) == pytest.approx(3 * shear / (shear + 0.01), rel=0.02)
    assert at(after, to_peak) == pytest.approx(3 * (whole - 64) / (whole + 17), rel=0.05)
    assert at(after, "v_d 16 ms to its long peak") < 0.5 < at(before, "v_d 16 ms to its long peak")


def test_the_commands_of_x_are_inputs_from_their_row_on():
    held, move = HeldForce(600, 4.0), XMove(1200, 0.5, 1500)
    rows = pressed_and_sheared()
    shown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rows, (held, move))
    unknown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rows, (held,))
    first = kernel.INPUTS.index("x known")
    x = {name: shown.inputs[:, first + k] for k, name in enumerate(kernel.CHARGED_INPUTS[first:])}
    assert len(x) == 6
    before, after = shown.rows < 1200, shown.rows >= 1500
    moving = ~before & ~after
    for name in x:
        assert not x[name][before].any()
        assert not unknown.inputs[:, kernel.INPUTS.index(name)].any()
    assert (x["x known"][~before] == x["x known"][-1]).all()
    assert (x["speed of x"][moving] > 0).all()
    assert not x["speed of x"][after].any()
    assert (np.diff(x["x started"][moving]) < 0).all()
    assert not x["x braked"][moving].any()
    assert (np.diff(x["x braked"][after]) < 0).all()
    # Nothing else changes.
    own = np.s_[:, [k for k, name in enumerate(kernel.INPUTS) if name not in x]]
    np.testing.assert_array_equal(shown.inputs[own], unknown.inputs[own])


def test_the_held_force_is_an_input_from_its_row_on():
    forces = (HeldForce(600, 4.0), HeldForce(1200, 2.0), HeldForce(1300, 3.0))
    shown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(pressed_and_sheared(), forces)
    unknown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(pressed_and_sheared())
    known = len(kernel.CHARGED_INPUTS)
    assert not unknown.inputs[:, known:].any()
    np.testing.assert_array_equal(shown.inputs[:, :known], unknown.inputs[:, :known])
    # Undo the compression of large numbers, x / sqrt(1 + |x|).
    said = shown.inputs[:, known:]
    large = np.sign(said) * (said**2 + np.sqrt(said**4 + 4 * said**2)) / 2
    x = dict(zip(kernel.INPUTS[known:], large.T, strict=True))
    assert x["force known"][shown.rows >= 600] == pytest.approx(1)
    for begin, end, share in ((600, 1200, 1.0), (1200, 1300, 0.5), (1300, 2000, 0.75)):
        at = (shown.rows >= begin) & (shown.rows < end)
        assert x["force to the first"][at] == pytest.approx(10 * (share - 1))
    shear = "sum of v_d since the touch to the touch"
    to_touch = shown.inputs[:, kernel.INPUTS.index(shear)]
    at = (shown.rows >= 1200) & (shown.rows < 1300)
    assert (np.sign(x["sum of v_d since the touch to the commanded force"][at]) == np.sign(
        to_touch[at]
    )).all()  # fmt: skip
    for name, tau_ms in (("change of force 60 ms", 60), ("change of force 400 ms", 400)):
        row = shown.rows[at]
        assert x[name][at] == pytest.approx(-5 * (1 - 1 / tau_ms) ** (row - 1199), rel=0.02)
        assert not x[name][shown.rows < 1200].any()


def test_with_the_commands_of_x_another_probability_is_asked_for():
    network = by_hand().network
    assert network is not None
    unsure = network.model_copy(update={"output": ((0.0, math.log(0.85 / 0.15)), (0.0, -50.0))})
    chosen = RigSettings(network=unsure, fire_probability=0.9, fire_probability_with_x=0.8)
    without = IncipientSlipDetector(chosen, RATE_Hz)
    assert samples(without.add(pressed_and_sheared())) == []
    known = IncipientSlipDetector(chosen, RATE_Hz)
    known.notice(HeldForce(600, 4.0))
    known.notice(XMove(1200, 0.5, 1500))
    (first, *_) = samples(known.add(pressed_and_sheared()))
    assert 1200 <= first < 1210
    same = IncipientSlipDetector(
        chosen.model_copy(update={"fire_probability_with_x": None}), RATE_Hz
    )
    same.notice(HeldForce(600, 4.0))
    same.notice(XMove(1200, 0.5, 1500))
    assert samples(same.add(pressed_and_sheared())) == []


def test_a_slip_that_follows_another_is_reported_once_the_first_is_over():
    """Impulses at 1.5 s, and 60 ms and 80 ms later; each is a slip for some 10 ms."""
    volts, rows = pressed_and_sheared(), np.arange(2200)
    for later in (1560, 1580):
        pulse = 15e-3 * np.exp(-(((rows - later) / 1.2) ** 2))
        volts += np.column_stack([-pulse, pulse])
    silent = RigSettings(network=by_hand().network)
    (only,) = samples(reported(volts, silent))
    assert only == pytest.approx(1500, abs=8)
    found = samples(reported(volts, silent.model_copy(update={"over_probability": 0.2})))
    assert found == pytest.approx([1500, 1560], abs=8), "40 ms pass at least"
    sooner = silent.model_copy(update={"over_probability": 0.2, "again_s": 0.018})
    assert samples(reported(volts, sooner)) == pytest.approx([1500, 1560, 1580], abs=8)


def less_sure() -> Network:
    """A network whose probability of a slip grows gradually with the impulse, up to 0.99."""
    network = by_hand().network
    assert network is not None
    gradual = tuple(0.3 if weight else 0.0 for weight in network.hidden[0][:-1])
    return network.model_copy(
        update={"hidden": ((*gradual, 0.0),), "output": ((8.0, -3.0), (0.0, -50.0))}
    )


def test_the_first_slip_of_a_motion_may_have_to_be_surer_than_further_ones():
    """Impulses at 1.5 s, 1.56 s and 1.62 s, of which the second is the largest by far."""
    volts, rows = pressed_and_sheared(), np.arange(2200)
    for later, size_V in ((1560, 0.1), (1620, 0.015)):
        pulse = size_V * np.exp(-(((rows - later) / 1.2) ** 2))
        volts += np.column_stack([-pulse, pulse])
    chosen = RigSettings(
        network=less_sure(), fire_probability=0.8, over_probability=0.2, again_s=0.018
    )
    assert samples(reported(volts, chosen)) == pytest.approx([1500, 1560, 1620], abs=8)
    surer = chosen.model_copy(update={"first_probability": 0.94})
    assert samples(reported(volts, surer)) == pytest.approx([1560, 1620], abs=8)
    never = chosen.model_copy(update={"first_probability": 0.99})
    assert samples(reported(volts, never)) == []


def test_a_first_slip_that_is_not_sure_enough_is_not_said_to_be_unlike_a_slip():
    """It was "unlike a slip", as what the network finds improbable."""
    volts = pressed_and_sheared()
    chosen = RigSettings(network=less_sure(), fire_probability=0.8, first_probability=0.99)
    events = reported(volts, chosen)
    (withheld,) = [one for one in events if one.kind == "rejected"]
    assert withheld.reason == (
        "like a slip, but not probable enough for the first of a motion or just after x has turned"
    )
    assert 0.01 < withheld.confidence < 0.2, "that it is not a slip"
    (other,) = [
        one
        for one in reported(volts, chosen.model_copy(update={"fire_probability": 0.98}))
        if one.kind == "rejected"
    ]
    assert other.reason == "unlike a slip"


def test_a_slip_after_a_turn_of_x_may_have_to_be_surer_than_others():
    """An impulse at 1.5 s, shortly after x was commanded to turn, or long after it, or to go on."""
    chosen = RigSettings(
        network=less_sure(), fire_probability=0.8, turn_probability=0.99, turn_s=0.05
    )

    def detected(*moves: XMove) -> list[SlipEvent]:
        detector = IncipientSlipDetector(chosen, RATE_Hz)
        for notice in (HeldForce(600, 4.0), *moves):
            detector.notice(notice)
        return [*detector.add(pressed_and_sheared()), *detector.end()]

    moved = XMove(1200, 0.5, 1390)
    found = pytest.approx([1500], abs=8)
    assert samples(detected()) == found
    assert samples(detected(XMove(1480, 0.5, 1900))) == found, "the first move is not a turn"
    assert samples(detected(moved, XMove(1480, 0.5, 1900))) == found
    assert samples(detected(moved, XMove(1400, -0.5, 1900))) == found, "long ago"
    turned = detected(moved, XMove(1480, -0.5, 1900))
    assert samples(turned) == []
    (withheld,) = [one for one in turned if one.kind == "rejected"]
    assert withheld.reason.endswith("just after x has turned")
    kept = XMove(1395, -0.002, 1900)  # a weight is kept at rest by such moves
    assert samples(detected(moved, kept, XMove(1480, 0.5, 1900))) == found
    without_force = IncipientSlipDetector(chosen, RATE_Hz)
    for notice in (moved, XMove(1480, -0.5, 1900)):
        without_force.notice(notice)
    assert samples(without_force.add(pressed_and_sheared())) == found, "no commands are known"
    with pytest.raises(ValueError, match="together"):
        RigSettings(network=less_sure(), turn_probability=0.99)


def test_the_detector_for_grips_is_rig_with_a_surer_first_alarm():
    rig, grip = named_detectors()["rig"], named_detectors()["rig-grip"]
    assert isinstance(grip, RigSettings)
    assert grip.first_probability == 0.99
    assert grip.model_copy(update={"first_probability": None}) == rig
    assert "first_probability" not in rig.model_dump(), (
        "not stated, so that the fingerprint is that without it"
    )


def test_before_the_first_touch_the_gain_is_not_known_and_that_is_an_input():
    looks = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(pressed_and_sheared())
    touched = looks.inputs[:, kernel.INPUTS.index("touched")] > 0
    assert not touched[looks.rows < 500].any()
    assert touched[looks.rows > 800].all()


@given(cuts=st.lists(st.integers(1, 2199), max_size=40))
@settings(max_examples=20, deadline=None)
def test_events_do_not_know_how_the_rows_came(cuts: list[int]):
    volts = bursting(drifting(pressed_and_sheared(2, noise_mV=0.8)))
    detector = IncipientSlipDetector(by_hand(), RATE_Hz)
    events = [
        event for block in np.split(volts, sorted(set(cuts))) for event in detector.add(block)
    ]
    assert events + detector.finish() == reported(volts)


def test_bursts_and_motion_do_not_raise_the_noise():
    still = IncipientSlipDetector(by_hand(), RATE_Hz)
    still.add(np.tile(pressed_and_sheared(3)[:250], (8, 1)))
    moved = IncipientSlipDetector(by_hand(), RATE_Hz)
    moved.add(bursting(pressed_and_sheared(3)))
    for name in ("noise", "fast_noise"):
        np.testing.assert_allclose(moved._state[name], still._state[name], rtol=0.35)


def test_noise_that_hides_slips_is_said_and_not_judged():
    volts = pressed_and_sheared(4)
    volts[900:] += 20e-3 * np.random.default_rng(4).standard_normal((1300, 2))
    # The least of the latest pieces decides, so that the noise has to last.
    hidden = 20e-3 * np.random.default_rng(5).standard_normal((6000, 2))
    events = reported(np.concatenate([volts, hidden, hidden]))
    (cannot,) = [event for event in events if event.kind == "cannot judge"]
    assert cannot.reason.startswith("too noisy")
    assert not [slip for slip in samples(events) if slip > cannot.sample]
    assert unjudged_s(events, 14.2) == ((cannot.time_s, 14.2),)


def lightly_touched(seed: int) -> np.ndarray:
    """Volts (2200, 2) of a ridge that hardly touches: its press is a twentieth of the usual one and
    its slip half of it, in both strips."""
    volts = pressed_and_sheared(seed, noise_mV=0.05)
    volts[:1000] *= 0.05
    volts[1000:] *= 0.5
    volts[1495:1510] += 4e-3
    return volts


def test_a_ridge_that_hardly_touches_is_judged_as_one_that_is_pressed_with_a_fifth():
    detector = IncipientSlipDetector(by_hand(), RATE_Hz)
    events = detector.add(lightly_touched(7))
    assert [event for event in events if "judge" in event.kind] == []
    (slip,) = samples(events)
    assert 1498 <= slip <= 1504
    assert detector._state["unit"][0] == kernel.LEAST_UNIT


def test_after_a_light_touch_what_moves_the_sum_is_judged_until_it_is_a_touch_down():
    """The sum of a slip may be the begin of a touch-down. The network looks on."""
    looks = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(lightly_touched(7))
    touched = looks.inputs[:, kernel.INPUTS.index("touched")] > 0
    assert touched[looks.rows > 1000].all()
    assert np.diff(looks.rows[looks.rows > 1000]).max() <= 4


def test_a_light_touch_is_replaced_by_one_that_is_not():
    light = 0.05 * pressed_and_sheared(8, noise_mV=0.05)[:1150]
    detector = IncipientSlipDetector(by_hand(), RATE_Hz)
    events = detector.add(np.concatenate([light, pressed_and_sheared(9)]))
    (slip,) = samples(events)
    assert slip == pytest.approx(1150 + samples(reported(pressed_and_sheared(9)))[0], abs=1)
    assert detector._state["unit"][0] == pytest.approx(1.0, rel=0.1)


def test_touch_downs_and_taps_are_no_rolls():
    """A network that calls everything a roll is believed only in a motion under load."""
    rolls = by_hand(roll_odds=50.0)
    volts = pressed_and_sheared(5)
    assert samples(reported(volts[:1150], rolls), "roll") == []
    tapped = volts[:1150].copy()
    tap = -12e-3 * np.sin(np.pi * np.arange(40) / 40)
    tapped[1000:1040] += np.column_stack([1.2 * tap, 0.8 * tap])
    assert samples(reported(tapped, rolls), "roll") == []
    (roll,) = samples(reported(volts, rolls), "roll")
    assert roll >= 1300


def test_a_network_of_earlier_inputs_still_works():
    inputs = kernel.FIXED_INPUTS
    earlier = by_hand().network
    assert earlier is not None
    hidden = earlier.hidden[0]
    network = earlier.model_copy(
        update={"inputs": inputs, "hidden": ((*hidden[: len(inputs)], hidden[-1]),)}
    )
    events = reported(pressed_and_sheared(6), DetectorSettings(network=network))
    assert samples(events)


def rubbish(kind: str) -> np.ndarray:
    """Volts (3000, 2) that no strip gives."""
    chance = np.random.default_rng(8)
    row = np.arange(3000)[:, None]
    if kind == "wandering":
        return 0.05 * np.cumsum(chance.standard_normal((3000, 2)), axis=0)
    if kind == "heavy-tailed":
        return np.clip(1e-3 * chance.standard_cauchy((3000, 2)), -11, 11)
    if kind == "square":
        return np.sign(np.sin(0.05 * row)) * np.array([10.5, 3.0])
    if kind == "stuck":
        return np.where(row % 1000 < 900, 0.0, 10.0) * np.array([1.0, 0.0])
    return np.zeros((3000, 2))


@pytest.mark.parametrize("kind", ["wandering", "heavy-tailed", "square", "stuck", "zero"])
def test_whatever_comes_the_inputs_are_finite_and_cannot_judge_takes_turns_with_judges_again(
    kind: str,
):
    looks = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rubbish(kind))
    assert np.isfinite(looks.inputs).all()
    events = reported(rubbish(kind))
    turns = [event.kind for event in events if "judge" in event.kind]
    expected = itertools.cycle(("cannot judge", "judges again"))
    assert turns == list(itertools.islice(expected, len(turns)))
    for begin_s, end_s in unjudged_s(events, 3.0):
        assert 0 <= begin_s < end_s <= 3.0


def test_moves_of_x_without_a_held_force_are_as_unknown_for_a_network_taught_with_both():
    """Files from before decision 0123 have them alone."""
    moves, force = (XMove(700, 0.5, 1500), XMove(1600, 0.3, 1800)), HeldForce(900, 4.0)
    rows = pressed_and_sheared()
    alone = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rows, moves)
    unknown = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rows)
    np.testing.assert_array_equal(alone.inputs, unknown.inputs)
    both = IncipientSlipDetector(by_hand(), RATE_Hz).network_inputs(rows, (*moves, force))
    for name in ("x known", "speed of x"):
        x = both.inputs[:, kernel.INPUTS.index(name)].astype(bool)
        assert not x[both.rows < 900].any()
        assert x[(both.rows >= 900) & (both.rows < 1500)].all()
    network = by_hand().network
    assert network is not None
    before = network.model_copy(
        update={
            "inputs": kernel.CHARGED_INPUTS,
            "hidden": tuple(
                (*row[: len(kernel.CHARGED_INPUTS)], row[-1]) for row in network.hidden
            ),
        }
    )
    shorter = by_hand().model_copy(update={"network": before})
    shown = IncipientSlipDetector(shorter, RATE_Hz).network_inputs(rows, moves)
    assert shown.inputs[shown.rows >= 700, kernel.CHARGED_INPUTS.index("x known")].all()


def test_the_settings_say_how_often_the_network_is_evaluated_and_noise_is_measured():
    """They stated 8 ms and every fourth quiet piece, which is true of other networks and logics."""
    source = inspect.getsource(DetectorSettings)
    adapted = len(kernel.ADAPTED_INPUTS)
    idle = f"every {kernel.ADAPTIVE_IDLE_ms:g} ms, or every {kernel.IDLE_ms:g} ms by a network of"
    pieces = f"second least of the latest {kernel.NOISE_PIECES}."
    assert f"{idle} fewer than {adapted} inputs" in source
    assert pieces in source
    assert f"with a network of {adapted} inputs or more" in source
    assert len(named_detectors()["rig"].network.inputs) >= adapted

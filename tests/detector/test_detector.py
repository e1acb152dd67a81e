"""The streaming detectors: the same events for any blocks, what is refused, what is reported."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rig.core.settings import fingerprint
from rig.detector import kernel
from rig.detector.detector import IncipientSlipDetector
from rig.detector.events import ONE_INVERTED, SlipEvent, unjudged_s
from rig.detector.network import Network
from rig.detector.settings import (
    DetectorSettings,
    RigSettings,
    named_detectors,
    settings_from_json,
)

RATE_Hz = 1000.0
NAMES = ("rig", "paper-literal", "paper-hp", "impulse")
LIGHT_mV = 3.0
"""Press after which the hump and the impulse are those of a slip for `rig`, too, which compares
them with the press."""


def bench_like(seed: int = 0, noise_mV: float = 0.2, press_mV: float = 12.0) -> np.ndarray:
    """Volts (1400, 2): quiet, a press on both strips, rest, a hump that ends in an impulse."""
    chance = np.random.default_rng(seed)
    time = np.arange(1400) / RATE_Hz
    press = np.where(
        (time > 0.3) & (time < 0.6), -press_mV * np.sin(np.pi * (time - 0.3) / 0.3), 0.0
    )
    hump = 4.0 * np.clip((time - 0.8) / 0.05, 0, 1) * (time < 1.1)
    impulse = -45.0 * np.exp(-(((time - 1.1) / 0.0012) ** 2))
    v_d = hump + impulse
    clean = np.column_stack([press + v_d / 2, press - v_d / 2])
    return 1e-3 * (clean + noise_mV * chance.standard_normal((1400, 2)))


def reported(volts: np.ndarray, name: str = "rig", **changes: object) -> list[SlipEvent]:
    """Events of a whole recording."""
    parameters = named_detectors()[name].model_copy(update=changes)
    detector = IncipientSlipDetector(parameters, RATE_Hz)
    return detector.add(volts) + detector.finish()


def kinds(events: list[SlipEvent]) -> list[str]:
    return [event.kind for event in events]


@pytest.mark.parametrize("name", NAMES)
def test_the_impulse_while_armed_is_reported_once_and_at_once(name: str):
    events = reported(bench_like(press_mV=LIGHT_mV), name)
    slips = [event for event in events if event.kind == "incipient slip"]
    assert [1095 <= event.sample <= 1110 for event in slips if event.sample > 1090] == [True]
    armed = [event.sample for event in events if event.kind == "predictive"]
    assert any(800 <= sample <= 860 for sample in armed)


@pytest.mark.parametrize("name", NAMES)
@given(cuts=st.lists(st.integers(1, 1399), max_size=40))
@settings(max_examples=25, deadline=None)
def test_events_do_not_know_how_the_rows_came(name: str, cuts: list[int]):
    volts = bench_like(3, noise_mV=1.0)
    detector = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
    events = []
    for block in np.split(volts, sorted(set(cuts))):
        events += detector.add(block)
    assert events + detector.finish() == reported(volts, name)


@pytest.mark.parametrize("name", NAMES)
def test_row_by_row_is_the_same_to_the_last_bit(name: str):
    volts = bench_like(4, noise_mV=0.7)
    detector = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
    events = [event for row in volts for event in detector.add(row[None, :])]
    assert events + detector.finish() == reported(volts, name)
    assert events


def test_blocks_longer_than_the_inner_slice_are_no_different():
    volts = np.concatenate([bench_like(seed) for seed in range(8)])
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    events = [
        event for k in range(0, len(volts), 777) for event in detector.add(volts[k : k + 777])
    ]
    assert events == reported(volts)


def test_the_low_pass_is_the_designed_filter():
    """The predictive level that an event carries, against scipy's filter of the same taps."""
    volts = bench_like(5)
    detector = IncipientSlipDetector(named_detectors()["paper-hp"], RATE_Hz)
    events = detector.add(volts)
    v_d = 1e3 * (volts[:, 0] - volts[:, 1])
    taps = detector.low_pass.taps
    low = signal.lfilter(taps, 1.0, np.concatenate([np.full(taps.size, v_d[0]), v_d]))[taps.size :]
    offset = np.median(v_d[:250])
    for event in events:
        assert event.features["predictive_mV"] == pytest.approx(
            low[event.sample] - offset, abs=0.03
        )
    assert events


@pytest.mark.parametrize("name", NAMES)
def test_swapped_channels_change_nothing(name: str):
    volts = bench_like(6)
    swapped = reported(volts[:, ::-1], name)
    assert [(e.kind, e.sample) for e in swapped] == [
        (e.kind, e.sample) for e in reported(volts, name)
    ]


@pytest.mark.parametrize("name", NAMES)
def test_inverted_polarity_changes_nothing(name: str):
    volts = bench_like(7)
    inverted = reported(-volts, name)
    assert [(e.kind, e.sample) for e in inverted] == [
        (e.kind, e.sample) for e in reported(volts, name)
    ]


@pytest.mark.parametrize("name", NAMES)
def test_an_offset_changes_nothing_but_the_last_bits(name: str):
    volts = bench_like(8)
    moved = reported(volts + np.array([0.3, -0.2]), name)
    assert [(e.kind, e.sample) for e in moved] == [
        (e.kind, e.sample) for e in reported(volts, name)
    ]


def test_an_impulse_without_a_predictive_signal_is_rejected_with_the_reason():
    volts = bench_like(9)
    volts[:, :] = 1e-3 * 0.2 * np.random.default_rng(9).standard_normal(volts.shape)
    volts[700] += (0.02, -0.02)
    events = reported(volts, "paper-hp")
    assert kinds(events) == ["rejected", "predictive"]  # its own low part comes after it
    assert events[0].reason == "not armed: no motion under load preceded it"
    assert events[0].sample == 700


@pytest.mark.parametrize("name", NAMES)
def test_noise_alone_says_nothing(name: str):
    noise = 1e-3 * np.random.default_rng(10).standard_normal((60_000, 2))
    assert not [e for e in reported(noise, name) if e.kind in ("incipient slip", "roll")]


@pytest.mark.parametrize("name", NAMES)
def test_silence_without_any_noise_says_nothing(name: str):
    assert reported(np.zeros((2000, 2)), name) == []


@pytest.mark.parametrize("name", NAMES)
def test_saturation_is_reported_and_nothing_is_judged_meanwhile(name: str):
    volts = bench_like(11)
    volts[1095:1105, 0] = 10.0
    events = reported(volts, name)
    judging = [(e.kind, e.reason, e.sample) for e in events if "judge" in e.kind]
    assert judging == [
        ("cannot judge", "saturated", 1095), ("judges again", "saturated", 1155)
    ]  # fmt: skip
    assert unjudged_s(events, 1.4) == ((1.095, 1.155),)
    assert not [e for e in events if e.kind == "incipient slip" and e.sample >= 1095]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("channel", [0, 1])
def test_a_dead_channel_is_reported_by_name_and_nothing_is_judged_after(name: str, channel: int):
    volts = bench_like(14)
    volts[:, channel] = 0.01
    events = reported(volts, name)
    (dead,) = [e.sample for e in events if e.reason.startswith(f"v_{channel + 1} is dead")]
    assert unjudged_s(events, 1.4) == ((0.0, 1.4),)
    assert dead <= 500
    assert not [e for e in events if e.kind == "incipient slip" and e.sample > dead]


@pytest.mark.parametrize("name", NAMES)
def test_a_channel_that_dies_on_the_way_is_reported(name: str):
    volts = bench_like(15)
    volts[250:, 1] = volts[250, 1]
    events = reported(volts, name)
    told_of = [event for event in events if "v_2 is dead" in event.reason]
    assert [(event.kind, event.sample) for event in told_of] == [("cannot judge", 750)]
    assert unjudged_s(events, 1.4) == ((0.25, 1.4),)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("channel", [0, 1])
def test_one_inverted_channel_is_reported(name: str, channel: int):
    volts = bench_like(16)
    volts[:, channel] *= -1
    assert ONE_INVERTED in [event.reason for event in reported(volts, name)]


@pytest.mark.parametrize("mains_Hz", [50.0, 60.0])
def test_mains_hum_is_reported_and_no_slip(mains_Hz: float):
    hum = 4e-3 * np.sin(2 * np.pi * mains_Hz * np.arange(5000) / RATE_Hz)
    noise = 1e-4 * np.random.default_rng(17).standard_normal((5000, 2))
    for name in NAMES:
        events = reported(noise + np.column_stack([1.05 * hum, hum]), name)
        assert [event.reason.split(":")[0] for event in events] == ["mains hum"]


def test_a_good_recording_raises_no_doubts():
    for seed in range(20, 24):
        reasons = {event.reason for event in reported(bench_like(seed))}
        assert not [one for one in reasons if one and not one.startswith(("not armed", "roll"))]


def test_what_is_never_quiet_is_reported_and_not_judged():
    time = np.arange(3000) / RATE_Hz
    swinging = 5e-3 * np.sin(2 * np.pi * 3 * time)
    events = reported(np.column_stack([swinging, -swinging]), "paper-hp")
    assert kinds(events) == ["cannot judge"]
    assert events[0].reason.startswith("not quiet")
    assert unjudged_s(events, 3.0) == ((0.0, 3.0),)


@pytest.mark.parametrize("name", ["rig", "impulse", "paper-literal", "paper-hp"])
@pytest.mark.parametrize("rows", [2, 10])
def test_a_few_rows_are_too_short_to_be_judged(name: str, rows: int):
    (event,) = reported(np.zeros((rows, 2)), name)
    assert (event.kind, event.sample) == ("cannot judge", rows - 1)
    assert event.reason.startswith("too short: offset and noise need 0.")


def test_what_is_too_short_to_be_quiet_is_reported_at_its_end():
    events = reported(np.zeros((200, 2)), "paper-hp")
    assert [(event.kind, event.sample) for event in events] == [("cannot judge", 199)]
    assert events[0].reason == "too short: offset and noise need 0.25 s"
    assert unjudged_s(events, 0.2) == ((pytest.approx(0.0, abs=0.001), 0.2),)


@pytest.mark.parametrize("name", ["paper-literal", "paper-hp"])
def test_what_becomes_quiet_late_is_judged_from_then_on_and_said_so(name: str):
    swinging = 5e-3 * np.sin(2 * np.pi * 3 * np.arange(1500) / RATE_Hz)
    volts = np.concatenate([np.column_stack([swinging, -swinging]), bench_like(18)])
    events = reported(volts, name)
    judging = [(event.kind, event.sample) for event in events if "judge" in event.kind]
    assert judging == [("cannot judge", 999), ("judges again", 1749)]
    assert unjudged_s(events, 2.9) == ((0.0, 1.749),)
    assert "incipient slip" in kinds(events)


def test_a_gap_is_reported_and_begins_anew():
    volts = bench_like(12)
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    detector.add(volts[:400], first_sample=0)
    events = detector.add(volts[450:], first_sample=450)
    assert events[0].kind == "cannot judge"
    assert events[0].reason.startswith("gap of 50 samples")
    assert events[0].sample == 450
    assert unjudged_s(events, 1.4) == ((0.4, 0.45),)
    assert detector.rows == 1400


def test_rows_that_came_before_are_refused():
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    detector.add(bench_like()[:100], first_sample=0)
    with pytest.raises(ValueError, match="first_sample 90 must be at least 100: rows came twice"):
        detector.add(bench_like()[90:], first_sample=90)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_is_refused_by_channel_and_sample(value: float):
    volts = bench_like()
    volts[321, 1] = value
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    detector.add(volts[:300])
    with pytest.raises(ValueError, match=r"v_2 is (nan|inf) V at sample 321"):
        detector.add(volts[300:])


@pytest.mark.parametrize(
    ("name", "rate_Hz", "said"),
    [
        ("rig", 2000.0, "rate 2000 Hz must be 1000 Hz for the detector 'rig'"),
        ("paper-hp", 10_000.0, "rate 10000 Hz must be between 500 and 4000 Hz"),
        ("paper-hp", 100.0, "rate 100 Hz must be between 500 and 4000 Hz"),
    ],
)
def test_a_rate_at_which_it_means_nothing_is_refused(name: str, rate_Hz: float, said: str):
    with pytest.raises(ValueError, match=said):
        IncipientSlipDetector(named_detectors()[name], rate_Hz)


def test_wrong_shapes_are_refused():
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    with pytest.raises(ValueError, match=r"volts of shape \(10,\) must be \(n, 2\)"):
        detector.add(np.zeros(10))


def test_the_network_of_the_package_fits_the_detector():
    network = named_detectors()["rig"].network
    assert network is not None
    assert network.inputs == kernel.INPUTS
    assert 0 <= network.first_seed <= network.last_seed < 1_000_000


def test_parameters_of_earlier_files_keep_their_fingerprint():
    """Their processed files have it, and their names."""
    today = named_detectors()["rig"]
    before = DetectorSettings(network=today.network)
    read = RigSettings.model_validate_json(before.model_dump_json())
    assert fingerprint(read) == fingerprint(before) != fingerprint(today)
    assert settings_from_json(before.model_dump_json()) == read


def test_parameters_are_read_as_they_were_written():
    for settings_ in named_detectors().values():
        read = settings_from_json(settings_.model_dump_json())
        assert read == settings_
        assert type(read) is type(settings_)
    for text in ("[1]", "{", '{"logic": "rig"}'):
        with pytest.raises(ValueError, match=r"validation error|Expecting"):
            settings_from_json(text)


def test_a_network_of_other_inputs_is_refused():
    network = named_detectors()["rig"].network
    assert network is not None
    other = network.model_copy(update={"inputs": tuple(reversed(network.inputs)), "name": "old"})
    with pytest.raises(ValueError, match="network 'old' needs other inputs"):
        IncipientSlipDetector(DetectorSettings(network=other), RATE_Hz)


@pytest.mark.parametrize(
    "values",
    [
        {"hidden": ((0.0, 1.0),)},
        {"output": ((0.0,), (0.0,))},
    ],
)
def test_a_network_whose_rows_do_not_fit_is_refused(values: dict[str, object]):
    network = named_detectors()["rig"].network
    assert network is not None
    with pytest.raises(ValueError, match="rows must have"):
        Network.model_validate(network.model_dump() | values)


def test_logic_and_network_belong_together():
    with pytest.raises(ValueError, match="the logic 'rig' needs a trained network"):
        DetectorSettings()
    with pytest.raises(ValueError, match="the published ones have none"):
        DetectorSettings(logic="paper-hp", network=named_detectors()["rig"].network)


def test_what_the_network_sees_is_what_it_was_asked():
    """Rows it was shown for training are those of the live run: the same answers fire."""
    volts = bench_like(13, press_mV=LIGHT_mV)
    parameters = named_detectors()["rig"]
    assert parameters.network is not None
    looks = IncipientSlipDetector(parameters, RATE_Hz).network_inputs(volts)
    hidden, output = parameters.network.weights()
    total = looks.inputs @ hidden[:-1] + hidden[-1]
    odds = (total / (1 + np.abs(total))) @ output[0, :-1] + output[0, -1]
    probability = 1 / (1 + np.exp(-odds))
    asked = float(probability.max()) / 2
    events = IncipientSlipDetector(
        parameters.model_copy(update={"fire_probability": asked}), RATE_Hz
    ).add(volts)
    slips = [event.sample for event in events if event.kind == "incipient slip"]
    assert slips[0] == looks.rows[probability > asked][0]


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_the_kernels_median_is_numpys(values: list[float]):
    assert kernel._median(np.array(values)) == np.median(values)


def test_an_event_is_plain_data():
    event = reported(bench_like(), "paper-hp")[0]
    assert replace(event) == event
    assert set(event.features) == set(kernel.EVENT_FEATURES)
    assert event.time_s == event.sample / RATE_Hz
    assert 0 <= event.confidence <= 1

"""The simulated data acquisition unit, as its user and the instants of World time notice it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.instruments.keysight_u2300a import BUFFER_SAMPLES, KeysightU2300A
from drivers.simulated.instruments.u2300a_converter import CONVERTED_ROWS
from drivers.simulated.instruments.u2300a_models import MODELS, codes_of_volts, volts_of_codes

from ..ideal import IdealBench, Talk


@pytest.fixture
def bench() -> IdealBench:
    return IdealBench()


def unit_of(user: Talk) -> KeysightU2300A:
    assert isinstance(user.instrument, KeysightU2300A)
    return user.instrument


def user_of(bench: IdealBench, model: str = "U2331A") -> Talk:
    return Talk(KeysightU2300A(model, bench, bench), "hislip#1")


@pytest.fixture
def say(bench: IdealBench) -> Talk:
    return user_of(bench)


def read_words(say: Talk, channels: int, message: bytes = b"WAV:DATA?") -> npt.NDArray[np.int16]:
    reply = say.instrument.process(message, "test")
    assert reply is not None
    assert reply[:2] == b"#8"
    assert len(reply) == 10 + int(reply[2:10])  # and no line feed after the block
    return np.frombuffer(reply[10:], "<i2").reshape(-1, channels)


def test_it_cannot_be_mistaken_for_a_real_one(say: Talk) -> None:
    fields = (say("*IDN?") or "").split(",")
    assert fields[:2] == ["Agilent Technologies", "U2331A"]
    assert fields[2].startswith("SIM")


def test_single_shot_is_complete_when_its_time_has_passed(say: Talk, bench: IdealBench) -> None:
    bench.wave = lambda terminal, time_s: np.full_like(time_s, terminal - 101.0)
    say("ROUT:SCAN (@101,103);:ACQ:SRAT 1000;:ACQ:POIN 100;:DIG")
    bench.now_us = 99_999
    assert say("WAV:COMP?") == "NO"
    assert read_words(say, 2).size == 0
    assert say.errors() == [-230]
    bench.now_us = 100_000
    assert say("WAV:COMP?") == "YES"
    words = read_words(say, 2)
    assert words.shape == (100, 2)
    volts = (words >> 4) * 20.0 / 4095
    assert volts[0] == pytest.approx([0.0, 2.0], abs=20 / 4095)
    assert np.array_equal(read_words(say, 2), words)  # it can be read again


def test_continuous_blocks_follow_each_other_without_gap(say: Talk, bench: IdealBench) -> None:
    bench.wave = lambda terminal, time_s: time_s  # a ramp of 1 V/s
    say("ROUT:CHAN:RANG 1,(@101);:ACQ:SRAT 1000;:WAV:POIN 50;:RUN")
    assert say("WAV:STAT?") == "EPTY"
    bench.now_us = 49_000
    assert say("WAV:STAT?") == "FRAG"
    bench.now_us = 120_000
    assert say("WAV:STAT?") == "DATA"
    blocks = [read_words(say, 1) for _ in range(2)]
    assert say("WAV:STAT?") == "FRAG"
    volts = volts_of_codes(np.concatenate(blocks)[:, 0], 1.0, "BIP", 12)
    assert volts == pytest.approx(np.arange(100) / 1000, abs=0.6 * 2 / 4095)


def test_status_and_data_travel_in_one_message(say: Talk, bench: IdealBench) -> None:
    say("WAV:POIN 10;:RUN")
    bench.now_us = 10_000
    reply = say.instrument.process(b"WAV:STAT?;DATA?", "test")
    assert reply is not None
    assert reply.startswith(b"DATA;#800000020")


def test_full_buffer_stops_the_acquisition_until_it_is_begun_anew(
    say: Talk, bench: IdealBench
) -> None:
    say("ACQ:SRAT 1000000;:WAV:POIN 1000;:RUN")
    bench.now_us = BUFFER_SAMPLES  # a sample a microsecond: exactly full
    assert say("WAV:STAT?") == "DATA"
    bench.now_us += 1
    assert say("WAV:STAT?") == "OVER"
    assert read_words(say, 1).size == 0
    assert bench.entries[-1] == ("daq", "acquisition", "overrun", "itself")
    say("*CLS;RUN")
    assert say.errors() == []
    assert say("WAV:STAT?") == "EPTY"


def test_stop_ends_a_continuous_acquisition(say: Talk, bench: IdealBench) -> None:
    say("RUN;ACQ:SRAT 10")
    assert say.errors() == [-221]  # not while it runs
    say("STOP;:ACQ:SRAT 10")
    assert say.errors() == []
    assert say("WAV:STAT?") == "EPTY"
    assert [entry[2] for entry in bench.entries] == ["run", "stop"]


@pytest.mark.parametrize(
    ("model", "scan", "asked", "got"),
    [
        ("U2331A", "(@101)", 4e6, 3_000_000),
        ("U2331A", "(@101:103)", 4e5, 333_333),
        ("U2356A", "(@101:103)", 4e5, 166_666),
        ("U2355A", "(@101:103)", 4e5, 83_333),
        ("U2331A", "(@101)", 1, 3),
    ],
)
def test_sampling_rate_is_clipped_to_what_the_scan_allows(
    bench: IdealBench, model: str, scan: str, asked: float, got: int
) -> None:
    say = user_of(bench, model)
    say(f"ROUT:SCAN {scan};:ACQ:SRAT {asked}")
    assert say.errors() == [-222]
    assert say("ACQ:SRAT?") == str(got)


def test_simultaneous_model_gives_every_channel_its_full_rate(bench: IdealBench) -> None:
    say = user_of(bench, "U2542A")
    say("ROUT:ENAB ON,(@102,103);:ACQ:SRAT 500000")
    assert say("ROUT:ENAB? (@101:104);:ACQ:SRAT?") == "1,1,1,0;500000"
    assert say.errors() == []
    say("ROUT:ENAB OFF,(@101);:ROUT:SCAN (@101)")
    assert say("ROUT:ENAB? (@101:104)") == "0,1,1,0"
    assert say.errors() == [-113]


def test_a_scan_too_long_for_the_rate_is_refused_until_the_rate_is_lowered(say: Talk) -> None:
    say("ACQ:SRAT 600000;:ROUT:SCAN (@101,102)")
    assert say.errors() == [-221]
    assert say("ROUT:SCAN?") == "(@101)"
    say("ACQ:SRAT 3;:ROUT:SCAN (@101,102);:ACQ:SRAT 500000")
    assert say.errors() == []
    assert say("ROUT:SCAN?") == "(@101,102)"


@pytest.mark.parametrize(
    ("model", "burst", "lateness_us"),
    [("U2331A", "OFF", 250.0), ("U2331A", "ON", 1.0), ("U2542A", "OFF", 0.0)],
)
def test_multiplexer_samples_each_channel_a_little_later(
    bench: IdealBench, model: str, burst: str, lateness_us: float
) -> None:
    bench.wave = lambda terminal, time_s: time_s * 1000.0  # 1 V/ms shows the lateness in volts
    say = user_of(bench, model)
    pick = "ROUT:ENAB ON,(@101:104)" if model == "U2542A" else "ROUT:SCAN (@101:104)"
    say(f"{pick};:ACQ:SRAT 1000;:ACQ:POIN 3;:ACQ:BURS {burst};:ROUT:CHAN:RANG 5,(@101:104);:DIG")
    bench.now_us = 3000
    words = read_words(say, 4)
    volts = volts_of_codes(words, 5.0, "BIP", MODELS[model].bits)
    expected = lateness_us * 1e-3 * np.arange(4)
    assert volts[1] - 1.0 == pytest.approx(expected, abs=10 / 4095)


def test_signals_beyond_the_range_stay_at_the_rails(say: Talk, bench: IdealBench) -> None:
    bench.wave = lambda terminal, time_s: np.where(time_s < 0.5e-3, 7.0, -7.0)
    say("ROUT:CHAN:RANG 5,(@101);:ACQ:POIN 2;:DIG")
    bench.now_us = 2000
    assert read_words(say, 1)[:, 0].tolist() == [2047 << 4, -2048 << 4]


def test_codes_are_the_documented_ones() -> None:
    volts = np.array([-10.0, 0.0, 5.0, 10.0])
    assert codes_of_volts(volts, 10.0, "BIP", 16).tolist() == [-32768, 0, 16384, 32767]
    assert (codes_of_volts(volts, 10.0, "UNIP", 16)).tolist() == [-32768, -32768, 0, 32767]
    assert (codes_of_volts(volts, 10.0, "BIP", 12) >> 4).tolist() == [-2048, 0, 1024, 2047]
    assert (codes_of_volts(volts, 10.0, "BIP", 12) & 15).tolist() == [0, 0, 0, 0]


@given(
    volt=st.floats(-0.99, 0.99),
    full=st.sampled_from([10.0, 5.0, 0.05]),
    polarity=st.sampled_from(["BIP", "UNIP"]),
    bits=st.sampled_from([12, 16]),
)
def test_quantisation_is_half_a_step_at_most(
    volt: float, full: float, polarity: str, bits: int
) -> None:
    volts = np.array([volt * full if polarity == "BIP" else abs(volt) * full])
    step = (2 if polarity == "BIP" else 1) * full / (2**bits - 1)
    back = volts_of_codes(codes_of_volts(volts, full, polarity, bits), full, polarity, bits)
    assert abs(back - volts)[0] <= step * 0.501


def test_inputs_are_set_by_channel_and_read_back(say: Talk) -> None:
    say("ROUT:CHAN:RANG 2.5,(@101,102);:ROUT:CHAN:POL UNIP,(@102);:VOLT:STYP DIFF,(@101)")
    assert say("ROUT:CHAN:RANG? (@101:103)") == "2.5,2.5,10"
    assert say("ROUT:CHAN:POL? (@101,102);:ROUT:CHAN:STYP? (@101)") == "BIP,UNIP;DIFF"
    assert say.errors() == []


def test_range_that_does_not_exist_and_channel_that_does_not(say: Talk) -> None:
    say("ROUT:CHAN:RANG 3,(@101)")
    assert say.errors() == [-222]
    assert say("ROUT:CHAN:RANG? (@101)") == "5"
    say("ROUT:CHAN:RANG 5,(@200)")
    assert say.errors() == [-222]


def test_measure_gives_volts_now(say: Talk, bench: IdealBench) -> None:
    bench.wave = lambda terminal, time_s: time_s * (terminal - 100)
    bench.now_us = 1_000_000
    reply = say("MEAS? (@101,102)") or ""
    assert [float(v) for v in reply.split(",")] == pytest.approx([1.0, 2.0], abs=20 / 4095)


def test_later_settings_do_not_change_an_acquisition_already_taken(
    say: Talk, bench: IdealBench
) -> None:
    bench.wave = lambda terminal, time_s: np.ones_like(time_s)
    say("ACQ:POIN 4;:DIG")
    bench.now_us = 4000
    before = read_words(say, 1)
    say("ROUT:CHAN:RANG 1,(@101);:ROUT:SCAN (@102,103)")
    assert np.array_equal(read_words(say, 1), before)


def test_external_trigger_waits_for_ever_until_stopped(say: Talk, bench: IdealBench) -> None:
    say("TRIG:SOUR EXTD;:DIG")
    bench.now_us = 10**9
    assert say("WAV:COMP?;:TRIG:SOUR?") == "NO;EXTD"
    say("STOP;:TRIG:SOUR NONE;:DIG")
    bench.now_us += 10**6
    assert say("WAV:COMP?") == "YES"


def test_acquisitions_are_numbered_for_their_noise(say: Talk, bench: IdealBench) -> None:
    say("DIG;STOP;DIG;STOP;*RST")
    assert bench.acquisitions == 2
    assert say.errors() == []


def test_every_model_of_the_family_takes_its_own_maximum(bench: IdealBench) -> None:
    for name, model in MODELS.items():
        say = user_of(bench, name)
        assert say("ACQ:SRAT MAX;:ACQ:SRAT?") == str(model.single_rate_S_s)
        assert say("*RST;ACQ:SRAT?;:ACQ:POIN?;:WAV:POIN?") == "1000;500;500"


def test_a_long_single_shot_is_converted_while_time_passes_and_not_when_it_is_read(
    say: Talk, bench: IdealBench
) -> None:
    asked: list[int] = []

    def wave(terminal: int, time_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        asked.append(time_s.size)
        return np.sin(40 * time_s + terminal)

    bench.wave = wave
    unit, rows = unit_of(say), 5 * CONVERTED_ROWS + 123
    say(f"ROUT:SCAN (@101,102);:ACQ:SRAT 64000;:ACQ:POIN {rows};:DIG")
    while say("WAV:COMP?") == "NO":
        bench.now_us += 20_000
        unit.settle()
    asked.clear()
    words = read_words(say, 2)
    assert len(words) == rows
    assert max(asked) < CONVERTED_ROWS  # it was all of the record, and a client waited for it


def test_words_do_not_depend_on_when_they_were_converted(bench: IdealBench) -> None:
    bench.wave = lambda terminal, time_s: np.sin(40 * time_s + terminal)
    patient, hasty = user_of(bench), user_of(bench)
    for user in (patient, hasty):
        user(f"ROUT:SCAN (@101,102);:ACQ:SRAT 64000;:ACQ:POIN {2 * CONVERTED_ROWS + 5};:DIG")
    for bench.now_us in range(0, 1_200_000, 10_000):
        unit_of(patient).settle()
    np.testing.assert_array_equal(read_words(patient, 2), read_words(hasty, 2))
    for user in (patient, hasty):  # a further record has nothing of the one before
        user("DIG")
    bench.now_us += 1_200_000
    unit_of(patient).settle()
    np.testing.assert_array_equal(read_words(patient, 2), read_words(hasty, 2))

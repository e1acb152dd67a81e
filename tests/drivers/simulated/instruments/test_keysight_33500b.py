"""The simulated generator, as its user at a terminal and the World behind it notice it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.transports.scpi import block

from ..ideal import IdealBench, Talk


@pytest.fixture
def bench() -> IdealBench:
    return IdealBench()


@pytest.fixture
def say(bench: IdealBench) -> Talk:
    return Talk(Keysight33500B(bench, bench), "hislip#1")


def value(reply: str | None) -> float:
    assert reply is not None
    return float(reply)


def test_it_cannot_be_mistaken_for_a_real_one(say: Talk) -> None:
    fields = (say("*IDN?") or "").split(",")
    assert fields[:2] == ["Agilent Technologies", "33512B"]
    assert len(fields) == 4
    assert fields[2].startswith("SIM")


def test_numbers_have_the_instruments_format(say: Talk) -> None:
    assert say("SOUR1:FREQ 250;:SOUR1:FREQ?") == "+2.500000000000000E+02"
    assert say("OUTP1:LOAD INF;:OUTP1:LOAD?") == "+9.900000000000000E+37"
    assert say("OUTP1?") == "0"


def test_the_world_sees_the_open_circuit_wave(say: Talk, bench: IdealBench) -> None:
    say("OUTP1:LOAD INF;:SOUR1:FREQ 2 HZ;VOLT 3;VOLT:OFFS 0.5;:SOUR1:PHAS 90;:OUTP1 ON")
    channel, wave, by = bench.excitations[-1]
    assert (channel, by) == (1, "hislip#1")
    assert (wave.on, wave.function, wave.frequency_Hz) == (True, "SIN", 2.0)
    assert (wave.amplitude_V, wave.offset_V) == (1.5, 0.5)
    assert wave.phase_rad == pytest.approx(math.pi / 2)
    assert say.errors() == []


def test_load_setting_changes_what_is_shown_not_what_is_put_out(
    say: Talk, bench: IdealBench
) -> None:
    say("VOLT 2;VOLT:OFFS 1;:OUTP1 1")
    reported = len(bench.excitations)
    assert say("OUTP1:LOAD INF;:VOLT?;VOLT:OFFS?") == (
        "+4.000000000000000E+00;+2.000000000000000E+00"
    )
    assert len(bench.excitations) == reported
    assert bench.excitations[-1][1].amplitude_V == 2.0
    assert say("OUTP1:LOAD 50;:VOLT?") == "+2.000000000000000E+00"


def test_log_names_who_changed_what_and_only_changes(say: Talk, bench: IdealBench) -> None:
    say("OUTP2 1;:OUTP2 1;:SOUR2:FREQ 5")
    assert bench.entries == [
        ("generator", "ch2.on", True, "hislip#1"),
        ("generator", "ch2.frequency_Hz", 5.0, "hislip#1"),
    ]


@pytest.mark.parametrize(
    ("setting", "query", "applied"),
    [
        ("FREQ 30 MHz", "FREQ?", 20e6),
        ("FREQ 0", "FREQ?", 1e-6),
        ("VOLT 11", "VOLT?", 10.0),
        ("VOLT 0", "VOLT?", 1e-3),
        ("VOLT 8;VOLT:OFFS 2", "VOLT:OFFS?", 1.0),
        ("VOLT:OFFS 3;:VOLT 8", "VOLT?", 4.0),
        ("VOLT:HIGH 6", "VOLT:HIGH?", 5.0),
        ("PHAS 400", "PHAS?", 360.0),
        ("BURS:NCYC 0", "BURS:NCYC?", 1.0),
        ("OUTP:LOAD 0.1", "OUTP:LOAD?", 1.0),
    ],
)
def test_out_of_range_is_clipped_applied_and_reported(
    say: Talk, setting: str, query: str, applied: float
) -> None:
    say(setting)
    assert say.errors() == [-222]
    assert value(say(query)) == pytest.approx(applied, rel=1e-12)


def test_minimum_and_maximum_can_be_asked_and_set(say: Talk) -> None:
    assert value(say("FREQ? MAX")) == 20e6
    assert value(say("OUTP1:LOAD INF;:VOLT? MAX")) == 20.0
    assert value(say("FREQ MIN;FREQ?")) == 1e-6
    assert say.errors() == []


def test_voltage_limits_guard_amplitude_and_offset(say: Talk, bench: IdealBench) -> None:
    say("OUTP1:LOAD INF;:VOLT 1;:VOLT:LIM:HIGH 2;LOW -2;STAT ON")
    assert say("VOLT:LIM:STAT?;HIGH?;LOW?") == "1;+2.000000000000000E+00;-2.000000000000000E+00"
    assert say.errors() == []
    say("VOLT 6")
    assert say.errors() == [-222]
    assert value(say("VOLT?")) == 4.0
    assert bench.excitations[-1][1].amplitude_V == 2.0
    say("VOLT 2;VOLT:OFFS -1.5")
    assert say.errors() == [-222]
    assert value(say("VOLT:OFFS?")) == -1.0
    say("VOLT:LIM:STAT OFF;:VOLT 6")
    assert value(say("VOLT?")) == 6.0


def test_limits_are_not_switched_on_around_a_larger_wave(say: Talk) -> None:
    say("VOLT 4;:VOLT:LIM:HIGH 1;STAT ON")
    assert say.errors() == [-221]
    assert say("VOLT:LIM:STAT?") == "0"


def test_high_and_low_are_amplitude_and_offset(say: Talk) -> None:
    say("VOLT:HIGH 3;LOW -1")
    assert (value(say("VOLT?")), value(say("VOLT:OFFS?"))) == (4.0, 1.0)


def test_amplitude_units(say: Talk) -> None:
    say("VOLT 1 VRMS")
    assert value(say("VOLT?")) == pytest.approx(2 * math.sqrt(2))
    say("VOLT 0 DBM")
    assert value(say("VOLT?")) == pytest.approx(0.632, abs=1e-3)  # 1 mW into 50 ohm
    say("VOLT:UNIT DBM;:VOLT 10")
    assert value(say("VOLT?")) == pytest.approx(10.0)
    say("VOLT:UNIT VRMS;:FUNC SQU;:VOLT 100 mVpp")
    assert value(say("VOLT?")) == pytest.approx(0.05)
    assert say.errors() == []


def test_dbm_needs_a_load(say: Talk) -> None:
    say("OUTP1:LOAD INF;:VOLT:UNIT DBM")
    assert say.errors() == [-221]
    assert say("VOLT:UNIT?") == "VPP"


def test_dc_carries_the_offset_alone(say: Talk, bench: IdealBench) -> None:
    say("FUNC DC;:VOLT:OFFS 1;:OUTP1 1")
    wave = bench.excitations[-1][1]
    assert (wave.function, wave.amplitude_V, wave.offset_V) == ("DC", 0.0, 2.0)


def test_function_that_is_too_slow_takes_the_frequency_down(say: Talk) -> None:
    say("FREQ 1 MHz;:FUNC RAMP")
    assert say.errors() == [-221]
    assert value(say("FREQ?")) == 200e3


def test_burst_settings_read_back_and_the_terminals_rest(say: Talk, bench: IdealBench) -> None:
    say("OUTP1 1;:BURS:NCYC 3;MODE GATED;STAT 1;INT:PER 2.5e-1;:TRIG1:SOUR BUS")
    assert say("BURS:STAT?;MODE?;NCYC?;INT:PER?;:TRIG1:SOUR?") == (
        "1;GAT;+3.000000000000000E+00;+2.500000000000000E-01;BUS"
    )
    assert bench.excitations[-1][1].amplitude_V == 0.0
    say("*TRG")
    assert say.errors() == []
    assert value(say("BURS:NCYC INF;NCYC?")) == 9.9e37


@pytest.mark.parametrize("header", ["AM:STAT", "FSK:STAT", "SUM:STATE", "SOUR1:PM:STATe"])
def test_a_modulation_ends_another_and_the_terminals_rest(
    say: Talk, bench: IdealBench, header: str
) -> None:
    say("OUTP1 1;:FM:STAT 1")
    say(f"{header} 1")
    assert (say(f"{header}?"), say("FM:STAT?")) == ("1", "0")
    assert bench.excitations[-1][1].amplitude_V == 0.0
    say("FM:STAT 0")
    assert bench.excitations[-1][1].amplitude_V == 0.0
    say(f"{header} 0")
    assert bench.excitations[-1][1].amplitude_V > 0.0


def test_the_terminals_rest_while_frequencies_are_swept_or_of_a_list(
    say: Talk, bench: IdealBench
) -> None:
    say("OUTP1 1;:FREQ:MODE LIST")
    assert say("FREQ:MODE?") == "LIST"
    assert bench.excitations[-1][1].amplitude_V == 0.0
    say("FREQ:MODE FIX")
    assert bench.excitations[-1][1].amplitude_V > 0.0


def test_trigger_that_nothing_waits_for_is_an_error(say: Talk) -> None:
    say("*TRG")
    assert say.errors() == [-211]


def test_inverted_polarity_is_half_a_turn(say: Talk, bench: IdealBench) -> None:
    say("OUTP1:POL INV")
    assert say("OUTP1:POL?") == "INV"
    assert bench.excitations[-1][1].phase_rad == pytest.approx(math.pi)


def test_channels_are_two_and_independent(say: Talk) -> None:
    say("SOUR2:FREQ 7")
    assert (value(say("SOUR1:FREQ?")), value(say("SOUR2:FREQ?"))) == (1000.0, 7.0)
    say("SOUR3:FREQ 7")
    assert say.errors() == [-114]


def test_reset_switches_the_outputs_off_and_says_so(say: Talk, bench: IdealBench) -> None:
    say("OUTP2 1;:SOUR2:VOLT 5;:VOLT:UNIT VRMS;*RST")
    channel, wave, _ = bench.excitations[-1]
    assert (channel, wave.on, wave.amplitude_V) == (2, False, 0.1)
    assert ("generator", "ch2.on", False, "hislip#1") in bench.entries
    assert say("VOLT:UNIT?;:FUNC?") == "VPP;SIN"


def test_arbitrary_waveforms_as_lists_and_blocks(say: Talk, bench: IdealBench) -> None:
    say("SOUR1:DATA:ARB:DAC ramp, " + ", ".join(map(str, range(-32767, 32768, 9000))))
    say("SOUR1:FUNC:ARB ramp;:SOUR1:FUNC ARB")
    samples = np.linspace(-1, 1, 1000, dtype="<f4")
    upload = b"FORM:BORD SWAP;:SOUR1:DATA:ARB wave," + block(samples.tobytes()) + b"\n"
    say.instrument.process(upload, "x")
    assert say("SOUR1:DATA:VOL:CAT?;:SOUR1:FUNC:ARB?;:SOUR1:FUNC?") == '"ramp","wave";"ramp";ARB'
    assert say.errors() == []
    assert bench.excitations[-1][1].function == "ARB"
    say("SOUR1:DATA:VOL:CLE;:SOUR1:FUNC:ARB ramp")
    assert say.errors() == [-224]


def test_waveform_beyond_full_scale_is_refused(say: Talk) -> None:
    say("SOUR1:DATA:ARB big, " + ",".join(["1.5"] * 8))
    assert say.errors() == [-222]


@pytest.mark.parametrize("header", ["FREQ", "VOLT", "VOLT:OFFS", "PHAS", "OUTP:LOAD", "BURS:NCYC"])
@pytest.mark.parametrize("number", ["1e999", "-1e999", "9.9e37", "1e-320"])
def test_absurd_numbers_end_at_a_limit(say: Talk, header: str, number: str) -> None:
    say(f"{header} {number}")
    assert set(say.errors()) <= {-222}
    assert -1e38 < value(say(f"{header}?")) < 1e38

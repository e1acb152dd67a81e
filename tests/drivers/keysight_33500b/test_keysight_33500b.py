"""The generator's driver on the wire: what is sent, in order, and what each reply leads to."""

from __future__ import annotations

import pytest
from pydantic import ValidationError
from transcript import playing

from drivers.keysight_33500b.driver import (
    Generator33500B,
    Keysight33500BSettings,
    connect,
    make_safe,
)
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError

IDENTITY = "Agilent Technologies,33512B,MY59000123,4.00-1.00-4.00-00-00"
NO_ERROR = '+0,"No error"'
CONNECT = (
    ("*IDN?", IDENTITY),
    ("*CLS;:SYST:ERR?", NO_ERROR),
    ("OUTP1 0;:OUTP1?;:SYST:ERR?", f"0;{NO_ERROR}"),
    *(
        (f"SOUR1:{mode}:STAT 0;:SOUR1:{mode}:STAT?;:SYST:ERR?", f"0;{NO_ERROR}")
        for mode in ("AM", "FM", "PM", "FSK", "BPSK", "PWM", "SUM", "BURS")
    ),
    ("SOUR1:FREQ:MODE CW;:SOUR1:FREQ:MODE?;:SYST:ERR?", f"CW;{NO_ERROR}"),
    ("OUTP1:LOAD INF;:OUTP1:LOAD?;:SYST:ERR?", f"+9.9E+37;{NO_ERROR}"),
    ("SOUR1:VOLT:LIM:STAT 0;:SOUR1:VOLT:LIM:STAT?;:SYST:ERR?", f"0;{NO_ERROR}"),
    ("SOUR1:FUNC SIN;:SOUR1:VOLT:UNIT VPP;:SYST:ERR?", NO_ERROR),
    ("SOUR1:VOLT 0.002;:SOUR1:VOLT?;:SYST:ERR?", f"+2.000000000000000E-03;{NO_ERROR}"),
    ("SOUR1:VOLT:OFFS 0;:SOUR1:VOLT:OFFS?;:SYST:ERR?", f"+0.0E+00;{NO_ERROR}"),
    ("SOUR1:VOLT:LIM:HIGH 2.5;:SOUR1:VOLT:LIM:HIGH?;:SYST:ERR?", f"+2.5E+00;{NO_ERROR}"),
    ("SOUR1:VOLT:LIM:LOW -2.5;:SOUR1:VOLT:LIM:LOW?;:SYST:ERR?", f"-2.5E+00;{NO_ERROR}"),
    ("SOUR1:VOLT:LIM:STAT 1;:SOUR1:VOLT:LIM:STAT?;:SYST:ERR?", f"1;{NO_ERROR}"),
)
SINE = "SOUR1:FREQ 200;:SOUR1:VOLT 1.5;:SOUR1:FREQ?;:SOUR1:VOLT?;:SYST:ERR?"
DONE = f"+2.000000000000000E+02;+1.500000000000000E+00;{NO_ERROR}"


def settings(resource: str, **more: object) -> Keysight33500BSettings:
    return Keysight33500BSettings.model_validate(
        {"resource": resource, "timeout_s": 1.0, "max_amplitude_V": 2.5, **more}
    )


def connected(resource: str, **more: object) -> Generator33500B:
    return connect(settings(resource, **more), WallClock())


def test_connecting_switches_off_before_anything_and_reads_every_limit_back() -> None:
    with playing("socket", *CONNECT) as resource:
        generator = connected(resource)
        assert generator.identity.model == "33512B"
        assert generator.identity.serial_number == "MY59000123"
        assert not generator.identity.simulated
        assert generator.limits()["amplitude"].high == 2.5
        generator.close()


def test_a_sweep_point_is_one_message_with_its_own_error_query() -> None:
    exchanges = (
        *CONNECT,
        (SINE, DONE),
        ("OUTP1 1;:OUTP1?;:SYST:ERR?", f"1;{NO_ERROR}"),
        ("OUTP1?", "1"),
        ("OUTP1 0;:OUTP1?", "0"),
    )
    with playing("socket", *exchanges) as resource:
        generator = connected(resource)
        generator.sine(200, 0.75)  # peak; the wire carries peak to peak
        generator.output(True)
        assert generator.output_is_on() is True
        generator.make_safe()
        generator.close()


def test_the_other_channel_over_hislip() -> None:
    exchanges = [(sent.replace("R1", "R2").replace("P1", "P2"), got) for sent, got in CONNECT]
    with playing("hislip", *exchanges) as resource:
        connected(resource, channel=2).close()


def test_half_an_answer_is_none_although_it_says_something() -> None:
    """HiSLIP and USBTMC end a message by themselves; only the line end tells that it is whole."""
    with playing("hislip", *CONNECT, ("OUTP1?", b"1")) as resource:
        generator = connected(resource)
        with pytest.raises(InstrumentError, match="the answer b'1' is not a whole line"):
            generator.output_is_on()
        generator.close()


def test_many_digits_reach_the_instrument() -> None:
    sent = "SOUR1:FREQ 1234.56789012;:SOUR1:VOLT 1.23456789;:SOUR1:FREQ?;:SOUR1:VOLT?;:SYST:ERR?"
    with playing("socket", *CONNECT, (sent, f"1.23456789012E3;1.23457;{NO_ERROR}")) as resource:
        generator = connected(resource)
        generator.sine(1234.56789012, 1.23456789 / 2)
        generator.close()


def test_a_clipped_value_is_reported_as_clipped() -> None:
    clipped = '+2.0E+02;+1.4E+00;-222,"Data out of range; value clipped to upper limit"'
    exchanges = (*CONNECT, (SINE, clipped), ("SYST:ERR?", NO_ERROR))
    with playing("socket", *exchanges) as resource:
        generator = connected(resource)
        with pytest.raises(InstrumentError) as caught:
            generator.sine(200, 0.75)
        generator.close()
    assert caught.value.message.startswith("generator: SOUR1:FREQ 200 ...: error -222: Data out")
    assert "clipped the value and applied the clipped one" in caught.value.message


def test_several_errors_are_reported_together_and_do_not_blame_the_next_command() -> None:
    exchanges = (
        *CONNECT,
        (SINE, '+2.0E+02;+1.4E+00;-222,"Data out of range"'),
        ("SYST:ERR?", '-221,"Settings conflict"'),
        ("SYST:ERR?", NO_ERROR),
        (SINE, DONE),
    )
    with playing("socket", *exchanges) as resource:
        generator = connected(resource)
        with pytest.raises(InstrumentError, match=r"error -222: .*; error -221: Settings conflict"):
            generator.sine(200, 0.75)
        generator.sine(200, 0.75)
        generator.close()


@pytest.mark.parametrize(
    ("reply", "reported"),
    [
        (f"+2.0E+02;+1.4E+00;{NO_ERROR}", "SOUR1:VOLT: set to 1.5 but reads back 1.4"),
        (f"+1.9E+02;+1.5E+00;{NO_ERROR}", "SOUR1:FREQ: set to 200 but reads back 190"),
        (f"+2.0E+02;nan;{NO_ERROR}", "reads back nan"),
        (f"+2.0E+02;loud;{NO_ERROR}", "'loud' is not a number"),
        (f"+2.0E+02;{NO_ERROR}", "is not 3 answers"),
        ("+2.0E+02;+1.5E+00;fine", "'fine' is not an error-queue entry"),
    ],
)
def test_a_reply_that_is_not_what_was_set_is_refused(reply: str, reported: str) -> None:
    with playing("socket", *CONNECT, (SINE, reply)) as resource:
        generator = connected(resource)
        with pytest.raises(InstrumentError) as caught:
            generator.sine(200, 0.75)
        generator.close()
    assert reported in caught.value.one_line()


@pytest.mark.parametrize(
    ("sent", "reply"),
    [
        ("OUTP1:LOAD INF;:OUTP1:LOAD?;:SYST:ERR?", f"+5.0E+01;{NO_ERROR}"),
        ("SOUR1:VOLT:LIM:HIGH 2.5;:SOUR1:VOLT:LIM:HIGH?;:SYST:ERR?", f"+1.0E+01;{NO_ERROR}"),
        ("SOUR1:VOLT:LIM:STAT 1;:SOUR1:VOLT:LIM:STAT?;:SYST:ERR?", f"0;{NO_ERROR}"),
        ("OUTP1 0;:OUTP1?;:SYST:ERR?", f"1;{NO_ERROR}"),
    ],
)
def test_a_limit_that_does_not_read_back_ends_the_connection(sent: str, reply: str) -> None:
    place = [message for message, _ in CONNECT].index(sent)
    with (
        playing("socket", *CONNECT[:place], (sent, reply)) as resource,
        pytest.raises(InstrumentError, match="reads back"),
    ):
        connected(resource)


def test_an_output_state_that_is_neither_on_nor_off_is_refused() -> None:
    with playing("socket", *CONNECT, ("OUTP1?", "2")) as resource:
        generator = connected(resource)
        with pytest.raises(InstrumentError, match="neither 0 nor 1"):
            generator.output_is_on()
        generator.close()


@pytest.mark.parametrize(
    "identity", ["Agilent Technologies,33220A,MY1,1.0", "Keysight,335", "33512B", ""]
)
def test_anything_else_than_a_33500b_is_refused_untouched(identity: str) -> None:
    with playing("socket", ("*IDN?", identity)) as resource, pytest.raises(InstrumentError):
        connected(resource)


def test_the_guards_make_safe_is_one_message_and_ignores_a_dead_runs_errors() -> None:
    """No error query: what a killed run left in the queue says nothing about the output."""
    with playing("socket", ("OUTP1 0;:OUTP1?", "0")) as resource:
        make_safe(settings(resource))


def test_the_guards_make_safe_believes_the_state_only() -> None:
    with (
        playing("socket", ("OUTP1 0;:OUTP1?", "1")) as resource,
        pytest.raises(InstrumentError, match="set to 0 but reads back 1"),
    ):
        make_safe(settings(resource))


@pytest.mark.parametrize("wrong", [{"max_amplitude_V": 11}, {"channel": 3}, {"timeout_s": 0}])
def test_settings_beyond_the_instrument_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        settings("TCPIP::127.0.0.1::5025::SOCKET", **wrong)


@pytest.mark.parametrize(
    "resource", ["nonsense", "TCPIP::no-such-host.invalid::5025::SOCKET", "GPIB0::3::INSTR"]
)
def test_a_resource_that_cannot_be_opened_is_an_instrument_error(resource: str) -> None:
    with pytest.raises(InstrumentError, match=r"generator: \*IDN\?"):
        connected(resource)

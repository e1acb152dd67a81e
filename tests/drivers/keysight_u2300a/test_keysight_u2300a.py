"""The DAQ's driver on the wire: set-up in the order the unit wants, and blocks of every kind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pydantic import ValidationError
from transcript import playing

from drivers.keysight_u2300a.driver import U2300ADaq, connect, make_safe
from drivers.keysight_u2300a.settings import KeysightU2300ASettings
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, LimitError
from rig.instruments.roles import Acquisition, InputChannel

NO_ERROR = '+0,"No error"'
CHANNELS = (InputChannel("film", 1.25), InputChannel("load_cell", 5.0))
THREE_ROWS = Acquisition(CHANNELS, 1000.0, 3)
WORDS = np.array([[16, -16], [32752, -32768], [0, 160]], "<i2")  # 12 bit: 1 -1, ends, 0 10
CODES = [[1, -1], [2047, -2048], [0, 10]]


def hello(model: str) -> tuple[tuple[str, str], ...]:
    return (
        ("*IDN?", f"Agilent Technologies,{model},TW54334510,A.2010.01.01"),
        ("*CLS;:STOP;:SYST:ERR?", NO_ERROR),
    )


RANGES = (
    "ROUT:CHAN:RANG 1.25,(@102);:ROUT:CHAN:POL BIP,(@102);"
    ":ROUT:CHAN:RANG 5,(@101);:ROUT:CHAN:POL BIP,(@101)"
)
SCAN = "STOP;:ACQ:SRAT 3;:ROUT:SCAN (@102,101);:ACQ:BURS ON"
SINGLE_SHOT = f"{SCAN};:{RANGES};:ACQ:SRAT 1000;:ACQ:POIN 3;:ACQ:SRAT?;:ACQ:POIN?;:SYST:ERR?"
STREAM = f"{SCAN};:{RANGES};:ACQ:SRAT 1000;:WAV:POIN 3;:ACQ:SRAT?;:WAV:POIN?;:SYST:ERR?"
SET_UP = f"1000;3;{NO_ERROR}"
REOPENED = ("*CLS", None)  # what the broken conversation left in the error queue is forgotten
ONCE = (("DIG;:SYST:ERR?", NO_ERROR), ("WAV:COMP?", "YES"))


def block(words: np.ndarray = WORDS) -> bytes:
    return b"#8%08d" % words.nbytes + words.tobytes()


def connected(resource: str) -> U2300ADaq:
    return connect(settings(resource), WallClock())


def settings(resource: str, **more: object) -> KeysightU2300ASettings:
    wiring = {"load_cell": 101, "film": 102}
    return KeysightU2300ASettings.model_validate(
        {"resource": resource, "timeout_s": 1.0, "channels": wiring, **more}
    )


def test_a_multiplexed_12_bit_unit_lowers_its_rate_sets_the_scan_and_samples_once() -> None:
    exchanges = (
        *hello("U2331A"),
        (SINGLE_SHOT, SET_UP),
        ("DIG;:SYST:ERR?", NO_ERROR),
        ("WAV:COMP?", "NO"),
        ("WAV:COMP?", "YES"),
        ("WAV:DATA?", block()),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        record = daq.acquire(THREE_ROWS)
        daq.close()
    assert record.counts.tolist() == CODES, "12-bit codes stand left-justified"
    assert record.first_index == 0
    scaling = record.scaling
    assert scaling.channels == ("film", "load_cell"), "the scan list keeps its order"
    assert record.volts("film")[1] == pytest.approx(2047 * 2.5 / 4095)
    assert record.volts("load_cell")[1] == pytest.approx(-2048 * 10 / 4095)
    assert record.delay_s("film") == 0
    assert record.delay_s("load_cell") == pytest.approx(1e-6), "one conversion at 1 MS/s"
    assert record.clipped("film") == 1
    assert record.clipped("load_cell") == 1


def test_a_simultaneous_unit_sends_terminal_order_and_the_record_has_the_order_asked_for() -> None:
    set_up = (
        "STOP;:ACQ:SRAT 3;:ROUT:ENAB ON,(@101,102);:ROUT:ENAB OFF,(@103,104);"
        f":{RANGES};:ACQ:SRAT 1000;:ACQ:POIN 3;:ACQ:SRAT?;:ACQ:POIN?;:SYST:ERR?"
    )
    words = np.array([[1, 2], [32767, -32768], [5, 6]], "<i2")
    with playing(
        "hislip", *hello("U2542A"), (set_up, SET_UP), *ONCE, ("WAV:DATA?", block(words))
    ) as resource:
        daq = connected(resource)
        record = daq.acquire(THREE_ROWS)
        daq.close()
    assert record.scaling.channels == ("film", "load_cell")
    assert record.scaling.range_V == (1.25, 5.0)
    assert record.counts.tolist() == words[:, ::-1].tolist()
    assert record.volts("load_cell")[1] == pytest.approx(32767 * 5 / 32768)
    assert record.volts("film")[1] == pytest.approx(-1.25)
    assert record.scaling.delay_s == (0.0, 0.0)


def test_the_same_acquisition_again_is_not_set_up_again() -> None:
    shot = (*ONCE, ("WAV:DATA?", block()))
    with playing("hislip", *hello("U2331A"), (SINGLE_SHOT, SET_UP), *shot, *shot) as resource:
        daq = connected(resource)
        assert daq.acquire(THREE_ROWS).counts.tolist() == CODES
        assert daq.acquire(THREE_ROWS).counts.tolist() == CODES
        daq.close()


def test_after_a_failure_the_unit_is_stopped_and_set_up_anew() -> None:
    exchanges = (
        *hello("U2331A"),
        (SINGLE_SHOT, SET_UP),
        ("DIG;:SYST:ERR?", NO_ERROR),
        ("WAV:COMP?", "PERHAPS"),
        REOPENED,
        (SINGLE_SHOT, SET_UP),
        *ONCE,
        ("WAV:DATA?", block()),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        with pytest.raises(InstrumentError, match="'PERHAPS' is not one of YES, NO"):
            daq.acquire(THREE_ROWS)
        assert daq.acquire(THREE_ROWS).counts.tolist() == CODES
        daq.close()


def test_the_rate_is_the_one_the_unit_reports() -> None:
    shot = (*ONCE, ("WAV:DATA?", block()))
    exchanges = (*hello("U2331A"), (SINGLE_SHOT, f"998;3;{NO_ERROR}"), *shot)
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        assert daq.acquire(THREE_ROWS).scaling.rate_S_s == 998.0
        daq.close()


@pytest.mark.parametrize(
    ("reply", "reported"),
    [
        (f"1000;2;{NO_ERROR}", "ACQ:POIN: set to 3 but reads back 2"),
        (f"0;3;{NO_ERROR}", "ACQ:SRAT: set to 1000 but reads back 0"),
        (f"fast;3;{NO_ERROR}", "'fast' is not a number"),
        (f"3;{NO_ERROR}", "is not 3 answers"),
    ],
)
def test_a_set_up_that_does_not_read_back_is_refused(reply: str, reported: str) -> None:
    with playing("hislip", *hello("U2331A"), (SINGLE_SHOT, reply)) as resource:
        daq = connected(resource)
        with pytest.raises(InstrumentError) as caught:
            daq.acquire(THREE_ROWS)
        daq.close()
    assert reported in caught.value.message
    assert caught.value.hint, "what to do is said, too"


# --- blocks ----------------------------------------------------------------------------------


@pytest.mark.parametrize("header", [b"#212", b"#3012", b"#8%08d" % 12, b"#9%09d" % 12])
@pytest.mark.parametrize("end", [b"", b"\n", b"\r\n"])
def test_a_block_may_have_any_header_and_end_with_a_line_feed(header: bytes, end: bytes) -> None:
    reply = header + WORDS.tobytes() + end
    exchanges = (*hello("U2331A"), (SINGLE_SHOT, SET_UP), *ONCE, ("WAV:DATA?", reply))
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        assert daq.acquire(THREE_ROWS).counts.tolist() == CODES
        daq.close()


def test_a_block_full_of_line_feeds_is_data() -> None:
    words = np.full((3, 2), 0x0A0A, "<i2")
    exchanges = (*hello("U2331A"), (SINGLE_SHOT, SET_UP), *ONCE, ("WAV:DATA?", block(words)))
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        assert (daq.acquire(THREE_ROWS).counts == 0x0A0).all()
        daq.close()


REFUSED_BLOCKS: dict[str, bytes] = {
    "one row short": block(WORDS[:2]),
    "one row long": block(np.vstack([WORDS, WORDS[:1]])),
    "announced but missing": b"#800000012" + WORDS.tobytes()[:7],
    "more than announced": block() + WORDS.tobytes(),
    "empty": b"#800000000\n",
    "no block": b"+1.25E+00\n",
    "indefinite": b"#0" + WORDS.tobytes() + b"\n",
    "letters for a length": b"#8twelve!!" + WORDS.tobytes(),
    "header only": b"#8",
    "line feed only": b"\n",
}


@pytest.mark.parametrize("reply", REFUSED_BLOCKS.values(), ids=REFUSED_BLOCKS.keys())
def test_any_other_block_is_refused(reply: bytes) -> None:
    exchanges = (*hello("U2331A"), (SINGLE_SHOT, SET_UP), *ONCE, ("WAV:DATA?", reply))
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        with pytest.raises(InstrumentError, match=r"daq: WAV:DATA\?: the answer .* is not"):
            daq.acquire(THREE_ROWS)
        daq.close()


# --- streaming -------------------------------------------------------------------------------


def test_a_stream_gives_blocks_that_say_where_they_begin() -> None:
    second = WORDS + np.int16(16)
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "EPTY"),
        ("WAV:STAT?", "FRAG"),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block(second)),
        ("STOP;:SYST:ERR?", NO_ERROR),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connect(settings(resource), StoppedClock())
        assert daq.start(THREE_ROWS).channels == ("film", "load_cell")
        assert daq.read() is None
        assert daq.read() is None
        one, two = daq.read(), daq.read()
        assert one is not None
        assert two is not None
        assert (one.first_index, two.first_index) == (0, 3)
        assert two.counts.tolist() == (second >> 4).tolist()
        daq.stop()
        daq.close()
    with pytest.raises(InstrumentError, match="no acquisition is running"):
        daq.read()


class StoppedClock(WallClock):
    """A clock that a test advances."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def now(self) -> float:
        return self.now_s


def test_a_reader_who_is_behind_asks_for_blocks_without_asking_whether_they_are_there() -> None:
    """A block takes 3 ms here. What the unit has said once, and the time since, show which blocks
    are complete; whether its buffer has overrun is asked again after 0.1 s."""
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()),
        ("WAV:STAT?", "FRAG"),
        ("WAV:DATA?", block()),
        ("WAV:DATA?", block()),
        ("WAV:DATA?", block()),
        ("WAV:STAT?", "FRAG"),
        ("WAV:STAT?", "OVER"),
    )
    clock = StoppedClock()
    with playing("hislip", *exchanges) as resource:
        daq = connect(settings(resource), clock)
        daq.start(THREE_ROWS)
        assert daq.read() is not None
        clock.now_s = 0.003  # of the computer's clock: the unit's may be slower
        assert daq.read() is None
        clock.now_s = 0.004
        assert daq.read() is not None
        clock.now_s = 0.011
        two, three = daq.read(), daq.read()
        assert two is not None
        assert three is not None
        assert (two.first_index, three.first_index) == (6, 9)
        assert daq.read() is None
        clock.now_s = 0.2
        with pytest.raises(InstrumentError, match="overran after row 12; samples are lost"):
            daq.read()
        daq.close()


def test_a_unit_whose_clock_is_slow_is_not_asked_for_a_block_before_it_is_there() -> None:
    """A clock that is 1 % slow, and a block of 3 rows that is asked for 3.01 ms after the last."""
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()),
        ("WAV:STAT?", "FRAG"),
    )
    clock = StoppedClock()
    with playing("hislip", *exchanges) as resource:
        daq = connect(settings(resource), clock)
        daq.start(THREE_ROWS)
        assert daq.read() is not None
        clock.now_s = 0.00301
        assert daq.read() is None
        daq.close()


@pytest.mark.parametrize(
    ("sent", "state", "named"),
    [
        (b"#10", "OVER", "overran after row 3; samples are lost"),
        (block()[:-5], "DATA", "announced bytes"),
    ],
)
def test_a_block_that_fails_without_a_question_before_is_blamed_on_an_overrun_only_where_it_was(
    sent: bytes, state: str, named: str
) -> None:
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()),
        ("WAV:DATA?", sent),
        REOPENED,
        ("WAV:STAT?", state),
    )
    clock = StoppedClock()
    with playing("hislip", *exchanges) as resource:
        daq = connect(settings(resource), clock)
        daq.start(THREE_ROWS)
        assert daq.read() is not None
        clock.now_s = 0.05
        with pytest.raises(InstrumentError, match=named):
            daq.read()
        daq.close()


def test_an_overrun_buffer_is_an_error_never_a_gap() -> None:
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "OVER"),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        daq.start(THREE_ROWS)
        with pytest.raises(InstrumentError, match="overran after row 0; samples are lost"):
            daq.read()
        daq.close()


def test_a_block_lost_on_the_wire_is_never_patched_with_the_next() -> None:
    """The unit hands a block out once: after a broken transfer the rows no longer count right."""
    exchanges = (
        *hello("U2331A"),
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()[:-5]),
        REOPENED,
        (STREAM, SET_UP),
        ("RUN;:SYST:ERR?", NO_ERROR),
        ("WAV:STAT?", "DATA"),
        ("WAV:DATA?", block()),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        daq.start(THREE_ROWS)
        with pytest.raises(InstrumentError, match="announced bytes"):
            daq.read()
        for _ in range(2):
            with pytest.raises(InstrumentError, match="block after row 0 was lost"):
                daq.read()
        daq.start(THREE_ROWS)
        record = daq.read()
        assert record is not None
        assert record.first_index == 0
        daq.close()


# --- limits ----------------------------------------------------------------------------------


def change(**values: object) -> Callable[[], Acquisition]:
    fields = {"channels": CHANNELS, "rate_S_s": 1000.0, "samples": 3, **values}
    return lambda: Acquisition(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wanted", "reported"),
    [
        (change(rate_S_s=500_001.0), "500001 S/s a channel for 2 channels is outside 3 to 500000"),
        (change(rate_S_s=2.0), "outside 3 to 500000"),
        (change(rate_S_s=float("nan")), "nan S/s"),
        (change(channels=(InputChannel("film", 3.0),)), "a range of 3 V does not exist"),
        (change(channels=(InputChannel("thumb", 5.0),)), "no terminal is named thumb"),
        (change(channels=CHANNELS[:1] * 2), "film, film"),
        (change(channels=()), "no channel"),
        (change(samples=0), "0 samples"),
        (
            change(samples=4_000_001),
            "4000001 samples of each of 2 channels are 8000002 in all, which is outside 1 to 8000",
        ),
    ],
)
def test_what_the_unit_cannot_do_is_refused_before_anything_is_sent(
    wanted: Callable[[], Acquisition], reported: str
) -> None:
    with playing("hislip", *hello("U2331A")) as resource:
        daq = connected(resource)
        for act in (daq.check, daq.acquire, daq.start):
            with pytest.raises(LimitError) as caught:
                act(wanted())
            assert "daq U2331A" in caught.value.message
            assert reported in caught.value.message
        daq.close()


def test_the_highest_rate_of_a_scan_is_one_the_unit_takes() -> None:
    with playing("hislip", *hello("U2331A")) as resource:
        daq = connected(resource)
        assert daq.highest_rate_S_s(3) == 333_333.0, "whole samples a second"
        daq.close()


def test_a_terminal_beyond_the_model_is_refused() -> None:
    identity = hello("U2542A")[:1]
    with playing("hislip", *identity) as resource, pytest.raises(LimitError, match="film = 105"):
        connect(settings(resource, channels={"film": 105}), WallClock())


@pytest.mark.parametrize("model", ["34972A", "U2722A", ""])
def test_another_unit_is_refused_untouched(model: str) -> None:
    with (
        playing("hislip", hello(model)[0]) as resource,
        pytest.raises(InstrumentError) as caught,
    ):
        connected(resource)
    assert f"{resource} is a Agilent Technologies {model}" in caught.value.message
    assert "one of U2331A" in caught.value.one_line()


@pytest.mark.parametrize(
    ("channels", "reported"),
    [
        ({}, "at least 1"),
        ({"film": 99}, "film = 99 is not a terminal"),
        ({"film": 102, "load_cell": 102}, "wired to one terminal"),
    ],
)
def test_wiring_that_cannot_be_is_refused(channels: dict[str, int], reported: str) -> None:
    with pytest.raises(ValidationError, match=reported):
        settings("USB0::0x0957::0x1518::TW1::INSTR", channels=channels)


def test_the_guards_make_safe_ends_whatever_runs() -> None:
    """No error query: what a killed run left in the queue says nothing about the unit."""
    with playing("hislip", ("STOP;*OPC?", "1")) as resource:
        make_safe(settings(resource))


def test_digital_lines_are_made_inputs_once_and_read_by_channel_and_bit() -> None:
    where = "(@501,503)"
    direction = f"CONF:DIG:DIR INP,{where};:CONF:DIG:DIR? {where};:SYST:ERR?"
    exchanges = (
        *hello("U2331A"),
        (direction, f"INP,INP;{NO_ERROR}"),
        (f"MEAS:DIG? {where}", "5,8"),
        (f"MEAS:DIG? {where}", "0,0"),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        names = ("501.0", "501.1", "503.3")
        assert daq.inputs_high(names) == {"501.0": True, "501.1": False, "503.3": True}
        assert not any(daq.inputs_high(names).values())
        daq.close()


@pytest.mark.parametrize("reply", ["", "OPEN", "1,2"])
def test_a_level_that_is_not_a_number_for_each_channel_is_refused(reply: str) -> None:
    direction = "CONF:DIG:DIR INP,(@501);:CONF:DIG:DIR? (@501);:SYST:ERR?"
    exchanges = (
        *hello("U2331A"),
        (direction, f"INP;{NO_ERROR}"),
        ("MEAS:DIG? (@501)", reply),
    )
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        with pytest.raises(InstrumentError, match="not a number for each channel"):
            daq.inputs_high(("501.0",))
        daq.close()


def test_a_digital_channel_that_stays_an_output_is_refused() -> None:
    direction = "CONF:DIG:DIR INP,(@502);:CONF:DIG:DIR? (@502);:SYST:ERR?"
    exchanges = (*hello("U2331A"), (direction, f"OUTP;{NO_ERROR}"))
    with playing("hislip", *exchanges) as resource:
        daq = connected(resource)
        with pytest.raises(InstrumentError, match="set to INP but read back OUTP"):
            daq.inputs_high(("502.7",))
        daq.close()

"""The SCPI grammar, as somebody who types commands would notice it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.transports.scpi import (
    Boolean,
    ChannelList,
    Choice,
    MessageSplitter,
    Numeric,
    ScpiBlock,
    ScpiCommand,
    ScpiError,
    ScpiInstrument,
    ScpiQuantity,
    block,
)

from ..ideal import Talk


class Lamp(ScpiInstrument):
    """A lamp with a few commands that record what they were given."""

    def __init__(self) -> None:
        self.seen: list[object] = []
        frequency = "[SOURce#:]FREQuency[:CW|:FIXed]"
        super().__init__(
            ("Maker", "Lamp", "SIM1", "1.0"),
            [
                ScpiCommand(frequency, self.see, (Numeric(("HZ",)),)),
                ScpiCommand(frequency + "?", lambda call: f"frequency {call.suffixes[0]}"),
                ScpiCommand("SOURce#:VOLTage:OFFSet", self.see, (Numeric(("V",)),)),
                ScpiCommand("SOURce#:VOLTage:HIGH", self.see, (Numeric(("V",)),)),
                ScpiCommand("SOURce#:VOLTage:HIGH?", lambda _: "high"),
                ScpiCommand("SHAPe", self.see, (Choice("SINusoid", "SQUare"),)),
                ScpiCommand("OUTPut", self.see, (Boolean(),)),
                ScpiCommand("ROUTe:SCAN", self.see, (ChannelList(),)),
                ScpiCommand("RANGe", self.see, (Numeric(("V",)), ChannelList()), optional=1),
                ScpiCommand("DATA?", lambda _: ScpiBlock(b"\n;\x00 ")),
            ],
        )

    def see(self, call) -> None:
        self.seen.append((*call.suffixes, *call.arguments))

    def reset(self, by: str) -> None:
        self.seen = ["reset"]


@pytest.fixture
def lamp() -> Lamp:
    return Lamp()


@pytest.fixture
def say(lamp: Lamp) -> Talk:
    return Talk(lamp)


@pytest.mark.parametrize(
    "header",
    ["SOUR2:FREQ?", "source2:frequency?", ":SOURce2:FREQuency:CW?", "Sour2:Freq:Fix?"],
)
def test_long_and_short_forms_and_optional_nodes_mean_the_same(say: Talk, header: str) -> None:
    assert say(header) == "frequency 2"


def test_source_left_out_means_channel_one(say: Talk) -> None:
    assert say("FREQ?") == "frequency 1"


@pytest.mark.parametrize("header", ["SOURC2:FREQ?", "FREQU?", "FREQ:LIST?", "FREQ:CW:FIX?", "?"])
def test_forms_in_between_are_undefined_headers(say: Talk, header: str) -> None:
    assert say(header) is None
    assert say.errors() == [-113]


def test_header_without_colon_continues_at_the_level_before(lamp: Lamp, say: Talk) -> None:
    assert say("SOUR2:VOLT:OFFS 1;HIGH 2;HIGH?;:SHAP SQU") == "high"
    assert lamp.seen == [(2, ScpiQuantity(1.0)), (2, ScpiQuantity(2.0)), ("SQU",)]
    assert say.errors() == []


def test_common_command_leaves_the_level_alone(say: Talk) -> None:
    assert say("SOUR1:VOLT:HIGH 1;*OPC?;HIGH?") == "1;high"


def test_a_header_of_the_root_needs_its_colon_after_a_deeper_one(say: Talk) -> None:
    assert say("SOUR1:VOLT:HIGH?;FREQ?") == "high"
    assert say.errors() == [-113]


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("1 kHz", 1e3), ("2.5E2", 250.0), (".5MHZ", 0.5e6), ("+3HZ", 3.0), ("7 mahz", 7e6),
        ("1e-3", 1e-3), ("20uHz", 20e-6),
    ],
)  # fmt: skip
def test_numbers_with_units(lamp: Lamp, say: Talk, typed: str, value: float) -> None:
    say(f"FREQ {typed}")
    assert lamp.seen[0][1].value == pytest.approx(value, rel=1e-15)
    assert say.errors() == []


def test_millivolts_are_not_megavolts(lamp: Lamp, say: Talk) -> None:
    say("SOUR1:VOLT:HIGH 5 mV")
    assert lamp.seen == [(1, ScpiQuantity(5e-3, "V"))]


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("FREQ fast", -104), ("FREQ 1 V", -131), ("FREQ", -109), ("FREQ 1,2", -108),
        ("FREQ INF", -104), ("SHAP ROUND", -224), ("SHAP 7", -104), ("OUTP perhaps", -104),
        ("ROUT:SCAN 101", -104), ("ROUT:SCAN (@105:101)", -102), ("ROUT:SCAN (@)", -104),
        ("BLINK 3", -113), ("*IDN? 1", -108), ("*ESE 400", -222), ("FREQ ONCE;MORE", -104),
        ("*ESE 1e999", -222), ("ROUT:SCAN (@1::2)", -102),
    ],
)  # fmt: skip
def test_what_is_refused_says_why(lamp: Lamp, say: Talk, message: str, code: int) -> None:
    assert say(message) is None
    assert say.errors()[0] == code
    assert lamp.seen == []


def test_channel_lists_keep_their_order(lamp: Lamp, say: Talk) -> None:
    say("ROUT:SCAN (@103, 101,105:107)")
    assert lamp.seen == [((103, 101, 105, 106, 107),)]


def test_commas_of_a_list_do_not_separate_parameters(lamp: Lamp, say: Talk) -> None:
    say("RANG 5,(@101,102);RANG 2")
    assert lamp.seen == [(ScpiQuantity(5.0), (101, 102)), (ScpiQuantity(2.0),)]


@pytest.mark.parametrize(("typed", "on"), [("1", True), ("ON", True), ("off", False), ("0", False)])
def test_flags(lamp: Lamp, say: Talk, typed: str, on: bool) -> None:
    say(f"OUTP {typed}")
    assert lamp.seen == [(on,)]


def test_an_error_inside_a_message_leaves_the_rest_and_its_error_query_alive(say: Talk) -> None:
    assert say("SHAP ROUND;:SYST:ERR?;:FREQ?") == '-224,"Illegal parameter value";frequency 1'


def test_queue_is_first_in_first_out_and_overflow_takes_the_last_place(say: Talk) -> None:
    say("BLINK;" * 25 + "FREQ")
    assert say.errors() == [-113] * 19 + [-350]
    assert say("SYST:ERR?") == '+0,"No error"'


def test_binary_block_ends_with_the_instruments_terminator(lamp: Lamp) -> None:
    assert lamp.process(b"DATA?", "x") == b"#800000004\n;\x00 \n"
    lamp.BLOCK_TERMINATOR = b""
    assert lamp.process(b"FREQ?;DATA?", "x") == b"frequency 1;#800000004\n;\x00 "


def test_identity_reset_and_status(lamp: Lamp, say: Talk) -> None:
    assert say("*IDN?") == "Maker,Lamp,SIM1,1.0"
    say("*RST")
    assert lamp.seen == ["reset"]
    assert say("*ESR?") == "+128"  # power on, once
    say("*ESE 32;*SRE 32;BLINK")
    assert say("*STB?") == "+100"  # queue 4, event summary 32, master summary 64
    assert lamp.status_byte(message_available=True) == 116
    assert say("*ESR?;*ESR?") == "+32;+0"
    say("*OPC;*CLS")
    assert say("*ESR?;*STB?;:SYST:ERR?") == '+0;+0;+0,"No error"'


def test_error_text_can_carry_a_detail() -> None:
    assert ScpiError(-222, "value clipped to upper limit").text == (
        "Data out of range; value clipped to upper limit"
    )


@given(
    payloads=st.lists(st.binary(max_size=40), min_size=1, max_size=4),
    cuts=st.lists(st.integers(1, 30), min_size=1, max_size=50),
)
def test_messages_survive_any_fragmentation_and_line_feeds_in_blocks(
    payloads: list[bytes], cuts: list[int]
) -> None:
    messages = [b"DATA x, " + block(payload) for payload in payloads] + [b"*IDN?"]
    stream = b"".join(message + b"\n" for message in messages)
    splitter, got = MessageSplitter(), []
    at = 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        got += splitter.feed(stream[at : at + step])
        at += step
    assert got == messages


def test_a_runaway_block_length_does_not_swallow_the_next_commands() -> None:
    assert MessageSplitter().feed(b"DATA x,#9999999999\n*IDN?\n") == [
        b"DATA x,#9999999999",
        b"*IDN?",
    ]


@given(st.binary(max_size=60))
def test_no_message_brings_an_instrument_down(data: bytes) -> None:
    lamp = Lamp()
    lamp.process(data, "x")
    lamp.process(b"*CLS", "x")
    assert lamp.process(b"*OPC?", "x") == b"1\n"

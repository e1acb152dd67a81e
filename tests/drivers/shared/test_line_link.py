"""The link of drivers that talk in lines: what comes late on a serial line is never an answer."""

from __future__ import annotations

import pytest

import drivers.shared.line_link as line_link
from drivers.shared.line_link import LineLink
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError


class Line:
    """A serial line on which an instrument answers ID?, and an older answer is still to come."""

    def __init__(self, late: bytes, identity: bytes):
        self.late, self.identity, self.input = late, identity, b""

    def write(self, data: bytes) -> None:
        answer = self.identity if data == b"ID?\n" else b"OK\n"
        self.input, self.late = self.input + self.late + answer, b""

    def read(self) -> bytes:
        data, self.input = self.input, b""
        return data

    def close(self) -> None:
        pass


def link_on(monkeypatch: pytest.MonkeyPatch, line: Line, place: str = "/dev/ttyUSB0") -> LineLink:
    monkeypatch.setattr(line_link, "open_port", lambda *given: line)
    return LineLink("generator", place, 0.05, WallClock(), resync=("ID?", r"ACME \S+"))


def test_an_answer_that_an_earlier_program_left_is_not_taken_for_the_first_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = link_on(monkeypatch, Line(b"OK\n", b"ACME W1\n"))
    assert link.ask("ID?", r"ACME (\S+)")[1] == "W1"
    assert link.ask("OUT 0", "OK")[0] == "OK"


def test_an_instrument_that_answers_otherwise_is_shown_with_its_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(InstrumentError, match="the answer 'WHAT' is not what was expected") as seen:
        link_on(monkeypatch, Line(b"", b"WHAT\n")).ask("ID?", r"ACME (\S+)")
    assert not isinstance(seen.value, InstrumentTimeoutError)


def test_a_stop_is_the_first_thing_that_is_sent_on_a_line_that_is_opened_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = Line(b"", b"")  # deaf to ID?
    assert link_on(monkeypatch, line).ask("OUT 0", "OK", charge=False)[0] == "OK"

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


class SlowLine(Line):
    """A line whose time is its own: it takes 1 s to open, and each answer some ms to come."""

    def __init__(self, answer_s: float):
        super().__init__(b"", b"ACME W1\n")
        self.now_s, self.answer_s, self.due_s = 0.0, answer_s, 0.0

    def opened(self, *given: object) -> Line:
        self.now_s += 1.0
        return self

    def monotonic(self) -> float:
        return self.now_s

    def write(self, data: bytes) -> None:
        super().write(data)
        self.due_s = self.now_s + self.answer_s

    def read(self) -> bytes:
        self.now_s += 0.005
        return super().read() if self.now_s >= self.due_s else b""


def slow_link(monkeypatch: pytest.MonkeyPatch, line: SlowLine) -> LineLink:
    link = link_on(monkeypatch, line)
    monkeypatch.setattr(line_link, "open_port", line.opened)
    monkeypatch.setattr(line_link, "time", line)
    return link


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


def test_an_instrument_that_echoes_commands_is_refused_with_that_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(InstrumentError) as seen:
        link_on(monkeypatch, Line(b"", b"ID?\r\n")).ask("ID?", r"ACME (\S+)")
    assert "the answer 'ID?\\r' is the command itself: it is echoed" in seen.value.message
    assert "switch off the echo" in str(seen.value.hint)


def test_a_stop_is_the_first_thing_that_is_sent_on_a_line_that_is_opened_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = Line(b"", b"")  # deaf to ID?
    assert link_on(monkeypatch, line).ask("OUT 0", "OK", charge=False)[0] == "OK"


def test_a_port_that_opens_slowly_leaves_the_whole_time_out_to_each_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The place is found again within one time-out of 50 ms, the answer comes within another."""
    link = slow_link(monkeypatch, SlowLine(answer_s=0.04))
    assert link.ask("ID?", r"ACME (\S+)")[1] == "W1"
    assert link.ask("OUT 0", "OK")[0] == "OK"


def test_an_instrument_without_an_answer_is_given_up_one_time_out_after_the_port_is_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = SlowLine(answer_s=9.0)
    with pytest.raises(InstrumentTimeoutError, match=r"no answer within 0\.05 s"):
        slow_link(monkeypatch, line).ask("ID?", r"ACME (\S+)", charge=False)
    assert line.now_s == pytest.approx(1.05, abs=0.011)

"""Whose silence it was that a drive's communication time-out reports."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from stages.festo import service

from drivers.shared.request_log import RequestLog
from rig.core.clock import SIGN_OF_LIFE_S, Clock, WallClock
from rig.core.errors import InstrumentError


class StoppedClock(WallClock):
    """A clock whose time a test sets."""

    at_s = 0.0

    def now(self) -> float:
        return self.at_s


def log_of(clock: StoppedClock, *times_s: float) -> RequestLog:
    """A log of requests at these times."""
    log = RequestLog(clock)
    for clock.at_s in times_s:
        log.note()
    return log


def test_requests_that_were_sent_did_not_arrive() -> None:
    said = log_of(StoppedClock(), 0.0, 0.1, 0.3, 0.4).whose_silence(2.0)
    assert said.startswith("requests were sent every 0.2 s or more often")
    assert said.endswith("the connection was silent")


def test_a_pause_in_the_requests_is_this_programs_and_is_remembered_for_a_while() -> None:
    clock = StoppedClock()
    paused = log_of(clock, 0.0, 0.1, 2.6, 2.7)
    assert paused.whose_silence(2.0) == (
        "this program sent it nothing for 2.5 s: the procedure hung, or the computer stood still "
        "or was suspended"
    )
    for clock.at_s in [2.7 + n for n in range(60)]:
        paused.note()
    assert "connection was silent" in paused.whose_silence(2.0)


def test_the_silence_of_a_suspended_computer_is_not_that_of_the_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = StoppedClock()
    log = log_of(clock, 0.0, 0.1)
    monkeypatch.setattr("drivers.shared.request_log.suspended_s", lambda: 1e6)
    log.note()
    assert log.whose_silence(2.0).endswith("the computer stood still or was suspended")


def test_an_instrument_that_kept_the_procedure_waiting_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, wall_s = StoppedClock(), iter((0.0, 0.0, 7.0, 7.0, 7.0))
    monkeypatch.setattr("rig.core.clock.time.monotonic", lambda: next(wall_s))
    with clock.answer_within(3.0, "daq"):
        pass
    assert clock.overdue == ("daq", 7.0)
    said = log_of(clock, 0.0, 6.0).whose_silence(2.0)
    assert said.endswith("the procedure waited for daq, without an answer for 7 s")


def test_an_answer_in_time_is_not_overdue() -> None:
    clock: Clock = WallClock()
    with clock.answer_within(SIGN_OF_LIFE_S, "daq"):
        pass
    assert clock.overdue is None


@pytest.mark.parametrize("silent", ["program", "connection"])
def test_a_drive_that_has_stopped_by_itself_says_whose_silence_it_was(silent: str) -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(20.0, 2.0)
        if silent == "program":
            it.bench.now_us += 700_000  # its communication time-out is 500 ms
        else:
            usual = it.wire.read

            def fault(address: int, count: int, by: str) -> Sequence[int]:
                registers = list(usual(address, count, by))
                if address == 100:
                    registers[0] |= 1 << 3
                    registers[9] = 391
                return registers

            it.wire.read = fault  # type: ignore[method-assign]
        words = "this program sent it nothing for 0.7" if silent == "program" else "connection was"
        with pytest.raises(InstrumentError, match=f"drive fault: 391.*{words}"):
            axis.moving()

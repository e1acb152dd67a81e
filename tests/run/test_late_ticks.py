"""A stop that a person asked for decides how a run ends, not the late ticks of a busy computer that
were noticed before the loop looked for a stop again."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from hand_clock import HandClock
from made_up import Example, run_of

from rig.bench.connected import Bench
from rig.control.tick_loop import BEHIND_FOR_S, Tick, tick_loop
from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.runfile.reader import RunFile
from rig.run.context import Run
from rig.run.points import Point, Reading
from rig.run.stopping import StopFlag

TICK_S = 0.024
"""Time that each tick takes, of a loop that asks for one every 10 ms."""


class Late(Example):
    """Its ticks come so late that its loop ends. A person asks for a stop between the loop's last
    look for one and the count of the late ticks."""

    def __init__(self, clock: HandClock, stop: StopFlag, asks: bool, off_fails: bool = False):
        super().__init__(Settings())
        self.clock, self._stop, self._asks, self._off_fails = clock, stop, asks, off_fails

    def arm(self, run: Run) -> None:
        super().arm(run)
        if self._off_fails:
            run.arm("heater", lambda: 1 / 0)  # type: ignore[arg-type,return-value]

    def take(self, run: Run, point: Point) -> Reading:
        self._run, self._begun_s = run, self.clock.now()
        tick_loop(self, 100.0, 10.0, self._late)
        raise AssertionError("the loop keeps its rate")

    def _late(self, tick: Tick) -> bool:
        self.clock.spend(TICK_S)
        return True

    def check_stop(self) -> None:
        self._run.check_stop()

    def check_watchers(self) -> None:
        self._run.check_watchers()
        if self._asks and self.clock.now() - self._begun_s > TICK_S + BEHIND_FOR_S:
            self._stop._remember(signal.SIGINT, None)


class RealClock(HandClock):
    """The same, for real time."""

    is_virtual = False


@pytest.mark.parametrize("clock", [HandClock, RealClock])
def test_who_simulates_in_real_time_on_a_slow_computer_learns_of_virtual_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: type[HandClock]
) -> None:
    monkeypatch.setattr(Bench, "simulated", True)
    procedure = Late(made := clock(), StopFlag(), asks=False)
    outcome = run_of(procedure, tmp_path, monkeypatch, clock=made)
    hint = str(outcome.failures[0].hint)
    assert "end other programs" in hint
    assert ("without --bench" in hint) == (clock is RealClock)


@pytest.mark.parametrize(
    ("asks", "off_fails", "code", "status"),
    [
        (True, False, ExitCode.SIGINT, "stopped"),
        (False, False, ExitCode.INSTRUMENT, "failed"),
        (True, True, ExitCode.UNSAFE, "failed"),
    ],
    ids=["a stop wins", "nobody asked for one", "an unsafe bench wins"],
)
def test_a_stop_wins_over_late_ticks_and_an_unsafe_bench_over_both(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asks: bool,
    off_fails: bool,
    code: ExitCode,
    status: str,
) -> None:
    clock, stop = HandClock(), StopFlag()
    procedure = Late(clock, stop, asks, off_fails)
    outcome = run_of(procedure, tmp_path, monkeypatch, stop=stop, clock=clock)
    assert (outcome.code, outcome.status) == (code, status)
    assert "off" in procedure.log
    words = "cannot keep 100 Hz: for 1.0 s at least every second tick had to be left out"
    said = outcome.warnings if asks else [failure.message for failure in outcome.failures]
    assert any(words in line for line in said)
    if asks:
        assert [failure.message for failure in outcome.failures] == ["stopped by Ctrl-C"]
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.outcome.status == status
        events = [message.decode() for message in run.entry["events/message"][()]]
    assert any(words in message for message in events)

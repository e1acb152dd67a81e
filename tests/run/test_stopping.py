"""A stop that is requested while nothing is connected: no code in between keeps it."""

from __future__ import annotations

import contextlib
import signal
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core import entry_points
from rig.core.entry_points import BENCHES, BrokenPackageError, load
from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.run.points import Point
from rig.run.stopping import NOTICE_WITHOUT_DATA, STOP_SIGNALS, StopFlag, StopRequestedError


def registered(monkeypatch: pytest.MonkeyPatch, folder: Path, source: str) -> None:
    """Register a module of this source as the simulated bench `lab`."""
    (folder / "lab_bench.py").write_text(source)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "lab_bench", raising=False)
    entry = EntryPoint("lab", "lab_bench", BENCHES)
    monkeypatch.setattr(entry_points, "_registered", lambda group: (entry,))


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_while_a_package_is_imported_is_a_stop_and_no_fault_of_the_package(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered(monkeypatch, tmp_path, f"import signal\nsignal.raise_signal({int(number)})\n")
    with (
        StopFlag() as stop,
        pytest.raises(StopRequestedError, match="before anything was connected") as stopped,
        stop.nothing_connected(),
        contextlib.suppress(BrokenPackageError),  # as a caller that can do without the package
    ):
        load(BENCHES, "lab")
    assert stopped.value.code == STOP_SIGNALS[number]


@pytest.mark.parametrize("code", [ExitCode.SIGHUP, ExitCode.SIGQUIT, ExitCode.SIGTERM])
def test_a_signal_that_leaves_the_program_is_no_fault_of_the_package_either(
    code: ExitCode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered(monkeypatch, tmp_path, f"import sys\nsys.exit({int(code)})\n")
    with pytest.raises(SystemExit, match=str(int(code))):
        load(BENCHES, "lab")


@pytest.mark.parametrize("made_of_it", ["nothing", "a failure of its own"])
def test_a_signal_that_the_interrupted_code_catches_ends_the_block_all_the_same(
    made_of_it: str,
) -> None:
    with (  # noqa: PT012 - what is interrupted is the block
        StopFlag() as stop,
        pytest.raises(StopRequestedError) as stopped,
        stop.nothing_connected(),
    ):
        try:
            signal.raise_signal(signal.SIGTERM)
        except Exception:  # noqa: BLE001 - as a library does that tries its plug-ins
            if made_of_it != "nothing":
                raise ImportError("the plug-in does not work") from None
    assert stopped.value.code == ExitCode.SIGTERM


def test_a_procedure_that_plans_for_ever_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Endless(Example):
        def points(self) -> tuple[Point, ...]:
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("the signal did not interrupt the plan")

    with StopFlag() as stop:
        outcome = run_of(Endless(Settings()), tmp_path, monkeypatch, stop=stop)
    assert (outcome.status, outcome.code) == ("stopped", ExitCode.SIGINT)
    assert "before anything was connected" in outcome.failures[0].message


def test_a_command_without_data_does_not_say_that_it_saves_any() -> None:
    said: list[str] = []
    with StopFlag(said.append, NOTICE_WITHOUT_DATA):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert said == ["stopping: making the bench safe ..."] * 2


def test_without_a_signal_a_failure_is_what_it_was() -> None:
    with pytest.raises(ImportError), StopFlag() as stop, stop.nothing_connected():
        raise ImportError("the plug-in does not work")


def test_under_nohup_a_terminal_that_closes_stops_nothing() -> None:
    """A night that was started so shall outlast the terminal; other signals stop it as ever."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopFlag() as stop:
            signal.raise_signal(signal.SIGHUP)
            stop.check()
            signal.raise_signal(signal.SIGTERM)
            assert stop.requested is signal.SIGTERM
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)

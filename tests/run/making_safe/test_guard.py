"""The guard over its real pipe, on real simulators: when it acts, what it does, what it leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.simulated.bench.start import start
from rig.bench.plan import BenchPlan, parse_bench
from rig.core.clock import ControlLink, WallClock
from rig.core.errors import InstrumentError
from rig.run.locks.bench_mark import read_marks
from rig.run.making_safe.guard import PRESSED_S, MadeSafe, act, make_bench_safe
from rig.run.making_safe.guard_link import GuardLink
from rig.run.making_safe.still_pressed import Orders, PressedState

PATIENCE_S = 60.0


class Bench:
    """A simulated bench in a process of its own, with its vibrator switched on."""

    def __init__(self, folder: Path):
        self.log_path = folder / "world.jsonl"
        self.journal = folder / "run.rigj"
        self.report = folder / "guard.json"
        self._started = start({"world_log": str(self.log_path)})
        ready = self._started.ready()
        self._control = ControlLink(ready["control_port"])
        self.plan: BenchPlan = parse_bench(ready["bench_toml"], "the simulated bench")
        part = self.plan.instruments[0]
        self.generator: Any = part.driver.connect(part.settings, WallClock())
        self.generator.output(True)

    def outputs(self) -> list[tuple[bool, str]]:
        """Every state of the output and who brought it about."""
        entries = [json.loads(line) for line in self.log_path.read_text().splitlines()]
        return [(e["value"], e["by"]) for e in entries if e["what"] == "ch1.on"]

    def order(self, **more: object) -> dict[str, Any]:
        """What a run tells its guard."""
        return {
            "run_pid": 0,
            "journal": str(self.journal),
            "report": str(self.report),
            "bench": "simulated",
            "marks": [],
            "bench_toml": self.plan.text,
            "bench_source": self.plan.source,
            "heartbeat_timeout_s": 60.0,
            **more,
        }

    def end(self) -> None:
        self.generator.close()
        self._control.stop()
        self._started.wait()


class Guard:
    """The guard's program at the end of a pipe."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rig.run.making_safe.guard"], stdin=subprocess.PIPE
        )

    def tell(self, word: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(word.encode() + b"\n")
        self.process.stdin.flush()

    def finish(self) -> int:
        assert self.process.stdin is not None
        self.process.stdin.close()
        return self.process.wait(PATIENCE_S)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.end()


@pytest.fixture
def guard() -> Iterator[Guard]:
    made = Guard()
    yield made
    if made.process.poll() is None:
        made.process.kill()
        made.process.wait()


@pytest.fixture
def run() -> Iterator[subprocess.Popen[bytes]]:
    """A process that stands for a hung run."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    yield process
    if process.poll() is None:
        process.kill()
    process.wait()


def report_of(bench: Bench) -> dict[str, Any]:
    """The guard's report, once it is final."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if bench.report.exists() and "file" in (report := json.loads(bench.report.read_text())):
            return report
        time.sleep(0.02)
    raise AssertionError("the guard never reported")


def test_a_run_that_is_done_leaves_its_guard_nothing_to_do(bench: Bench) -> None:
    link = GuardLink(bench.plan, bench.journal, bench.report)
    link.beat()
    link.safe()
    link.done()
    assert not bench.report.exists()
    assert [on for on, _ in bench.outputs()] == [True]


def test_a_guard_that_is_stopped_never_blocks_its_run_is_reported_and_ends_with_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More messages than a pipe holds: the next one would wait for ever."""
    monkeypatch.setattr("rig.run.making_safe.guard_link.SILENT_S", 0.1)
    monkeypatch.setattr("rig.run.making_safe.guard_link.ENDING_S", 0.1)
    link = GuardLink(bench.plan, bench.journal, bench.report)
    os.kill(link._process.pid, signal.SIGSTOP)
    for number in range(14_000):
        link.beat()
        link.hangs("a package" * 10)
        link.zero([float(number)] * 3)
        link.limit(10.0 + number)
    time.sleep(0.1)
    assert f"process {link._process.pid}" in str(link.trouble())
    link.safe()
    link.done()
    assert link._process.poll() is not None, "it holds no lock any more"
    assert not bench.report.exists()
    assert [on for on, _ in bench.outputs()] == [True]


@pytest.mark.thorough
def test_a_guard_that_is_stopped_is_continued_when_it_is_needed(bench: Bench) -> None:
    link = GuardLink(bench.plan, bench.journal, bench.report)
    link.beat()
    os.kill(link._process.pid, signal.SIGSTOP)
    for _ in range(2000):
        link.beat()
    link.zero([1.0, 2.0, 3.0])
    link.limit(11.0)
    assert link._unsent == {"zero": "[1.0, 2.0, 3.0]", "limit": "11.0"}
    taken_over = link.take_over()
    assert link._unsent == {}
    assert taken_over.safe, taken_over.summary
    assert report_of(bench)["file"] == "left to the run"
    assert taken_over.summary.startswith("the guard then made the bench safe, ")
    assert [on for on, _ in bench.outputs()] == [True, False]


@pytest.mark.thorough
def test_a_closed_pipe_makes_the_guard_act_on_a_connection_of_its_own(bench: Bench) -> None:
    link = GuardLink(bench.plan, bench.journal, bench.report)
    link.beat()
    taken_over = link.take_over()
    assert taken_over.safe, taken_over.summary
    assert taken_over.summary.startswith("the guard then made the bench safe, ")
    (_, run), (off, by) = bench.outputs()
    assert off is False
    assert by != run
    report = report_of(bench)
    assert report["safe"] is True
    assert report["cause"] == "the run ended without saying so"
    assert report["file"] == "left to the run"


def test_a_run_that_died_after_it_was_safe_is_compiled_only(bench: Bench, guard: Guard) -> None:
    guard.tell(json.dumps(bench.order()))
    guard.tell("safe")
    assert guard.finish() == 0
    assert report_of(bench)["safe"] is True
    assert [on for on, _ in bench.outputs()] == [True], "the guard did not touch the bench"


@pytest.mark.thorough
def test_a_late_beat_ends_the_run_and_then_makes_the_bench_safe(
    bench: Bench, guard: Guard, run: subprocess.Popen[bytes]
) -> None:
    guard.tell(json.dumps(bench.order(run_pid=run.pid, heartbeat_timeout_s=1.0)))
    for _ in range(30):
        guard.tell("beat")
        time.sleep(0.05)
    assert run.poll() is None, "beats keep the run alive"
    assert not bench.report.exists()
    report = report_of(bench)
    assert run.wait(PATIENCE_S) == -signal.SIGKILL
    assert "no sign of life for 1 s; the run was killed" in report["cause"]
    assert report["safe"] is True
    assert [on for on, _ in bench.outputs()] == [True, False]


@pytest.mark.thorough
def test_a_guard_that_reads_late_of_a_run_that_is_gone_kills_nothing(
    bench: Bench, guard: Guard, run: subprocess.Popen[bytes]
) -> None:
    """It was stopped while its run asked to be killed and then killed itself: the number may be
    another process's by now."""
    os.kill(guard.process.pid, signal.SIGSTOP)
    guard.tell(json.dumps(bench.order(run_pid=run.pid)))
    guard.tell("cause " + json.dumps("the procedure kept back its end"))
    guard.tell("kill")
    assert guard.process.stdin is not None
    guard.process.stdin.close()
    os.kill(guard.process.pid, signal.SIGCONT)
    report = report_of(bench)
    assert report["cause"] == "the procedure kept back its end"
    assert report["safe"] is True
    assert run.poll() is None


SIGNALS = (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP)
ALL_SIGNALS = sum(1 << (number - 1) for number in SIGNALS)
"""As the kernel shows them in /proc."""


@pytest.mark.thorough
def test_signals_do_not_keep_the_guard_from_its_work(bench: Bench, guard: Guard) -> None:
    guard.tell(json.dumps(bench.order(heartbeat_timeout_s=1.0)))
    guard.tell("beat")
    deadline = time.monotonic() + PATIENCE_S
    status = Path(f"/proc/{guard.process.pid}/status")
    while time.monotonic() < deadline:  # until it has set its handlers
        ignored = next(x for x in status.read_text().splitlines() if x.startswith("SigIgn"))
        # All of them: nohup, for one, hands some of them down as ignored.
        if int(ignored.split()[1], 16) & ALL_SIGNALS == ALL_SIGNALS:
            break
        time.sleep(0.01)
    for number in SIGNALS:
        guard.process.send_signal(number)
    assert guard.finish() == 0
    assert report_of(bench)["safe"] is True
    assert bench.outputs()[-1][0] is False


def test_a_guard_that_waits_has_imported_little() -> None:
    """Its start delays that of its run, and what it has imported takes memory until the end."""
    script = (
        "import sys, rig.run.making_safe.guard; "
        "print(*sorted(m for m in sys.modules if m.partition('.')[0] in ('rig', 'drivers')))"
    )
    imported = subprocess.check_output([sys.executable, "-P", "-c", script], text=True).split()
    assert imported == [
        "rig",
        "rig.core",
        "rig.core.atomic",
        "rig.core.errors",
        "rig.core.text",
        "rig.core.unreadable_packages",
        "rig.run",
        "rig.run.making_safe",
        "rig.run.making_safe.guard",
        "rig.run.making_safe.guard_report",
    ]


def test_a_guard_without_an_order_ends_quietly(guard: Guard) -> None:
    assert guard.finish() == 0


def test_a_bench_that_is_gone_is_reported_unsafe_with_every_instrument(
    tmp_path: Path, guard: Guard
) -> None:
    bench = Bench(tmp_path)
    bench.end()
    guard.tell(json.dumps(bench.order(marks=["an-address"])))
    guard.finish()
    report = report_of(bench)
    assert report["safe"] is False
    assert set(report["failures"]) == {"generator", "daq", "stage_z"}
    (mark,) = read_marks(["an-address"])
    assert mark.refuses
    for words in ("left unsafe at ", "generator: OUTP1 0", "daq: STOP", "stage_z: "):
        assert words in mark.in_words()


def test_the_lift_has_less_time_than_the_guard_waits_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Orders] = []

    def pressed(bench_toml: str, source: str, orders: Orders) -> PressedState:
        given.append(orders)
        return PressedState("nothing is pressed", released=True)

    monkeypatch.setattr("rig.run.making_safe.still_pressed.pressed_state", pressed)
    monkeypatch.setattr("rig.run.making_safe.guard.make_bench_safe", lambda *_: MadeSafe())
    order = {
        "run_pid": 0,
        "journal": None,
        "report": str(tmp_path / "guard.json"),
        "bench": "b",
        "marks": [],
        "bench_toml": "",
        "bench_source": "",
        "zero": [1.0, 2.0, 3.0],
        "limit": 40.0,
        "lifts": False,
    }
    assert act(order, "it died")["pressed"] == "nothing is pressed"
    assert given == [Orders((1.0, 2.0, 3.0), 40.0, lasting=False, lifts=False, within_s=PRESSED_S)]


def test_an_instrument_that_hangs_keeps_no_other_from_being_made_safe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    release, done = threading.Event(), list[str]()

    def part(role: str, make_safe: Callable[[object], object]) -> Any:
        driver = SimpleNamespace(make_safe=make_safe)
        return SimpleNamespace(role=role, driver=driver, settings=SimpleNamespace(timeout_s=0.01))

    def refuse(settings: object) -> None:
        raise InstrumentError("daq", "STOP", "no answer", "switch it on")

    parts = (
        part("generator", lambda settings: release.wait(PATIENCE_S)),
        part("daq", refuse),
        part("stage_z", lambda settings: done.append("stage_z")),
    )
    described = SimpleNamespace(instruments=parts, failures={})
    monkeypatch.setattr("rig.bench.plan.parse_to_make_safe", lambda *_: described)
    monkeypatch.setattr("rig.run.making_safe.guard.REST_S", 0.03)
    failures = make_bench_safe("", "bench.toml").failures
    release.set()
    assert failures == {
        "generator": "not done within 0.05 s",
        "daq": "STOP: no answer; switch it on",
    }
    assert done == ["stage_z"]


@pytest.mark.parametrize("left", [0, 1])
def test_without_a_thread_to_be_had_every_instrument_is_made_safe_all_the_same(
    monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    asked: list[str] = []

    def part(role: str, tries: int) -> Any:
        def make_safe(settings: object) -> None:
            asked.append(role)
            if asked.count(role) < tries:
                raise InstrumentError(role, "stop", "no answer", "switch it on")

        driver = SimpleNamespace(make_safe=make_safe)
        return SimpleNamespace(role=role, driver=driver, settings=SimpleNamespace(timeout_s=1.0))

    parts = part("generator", 2), part("daq", 9999), part("stage_z", 1)
    described = SimpleNamespace(instruments=parts, failures={})
    monkeypatch.setattr("rig.bench.plan.parse_to_make_safe", lambda *_: described)
    monkeypatch.setattr("rig.run.making_safe.guard.AGAIN_EVERY_S", 0.01)
    started, start_really = [], threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if len(started) >= left:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start_really(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)
    made = make_bench_safe("", "bench.toml", again_s=0.05)
    assert made.failures == {"daq": "stop: no answer; switch it on"}
    assert made.safe, "a DAQ drives nothing"
    assert asked.count("generator") == 2
    assert asked.count("stage_z") == 1
    assert len(started) == left


def test_without_a_thread_to_be_had_the_bench_is_switched_off_and_its_data_are_compiled(
    monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    monkeypatch.setattr(threading.Thread, "start", _no_thread)
    report = act(bench.order(), "a test")
    assert bench.outputs()[-1][0] is False
    assert report["failures"] == {}
    assert report["pressed"]
    assert "not compiled" in report["file"]


def _no_thread(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


@pytest.mark.thorough
def test_an_instrument_that_only_measures_leaves_no_bench_unsafe(
    monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    """A DAQ whose link is dead: it drives nothing, and is named all the same."""

    def refuse(settings: object) -> None:
        raise InstrumentError("daq", "STOP", "no answer", "switch it on")

    daq = next(part for part in bench.plan.instruments if part.role == "daq")
    monkeypatch.setattr(daq.driver, "make_safe", refuse)
    monkeypatch.setattr(
        "rig.run.making_safe.guard._add_what_is_pressed", lambda order, report: None
    )
    report = act(bench.order(marks=["an-address"]), "a test")
    assert report["safe"] is True
    assert report["failures"] == {"daq": "STOP: no answer; switch it on"}
    assert bench.outputs()[-1][0] is False
    (mark,) = read_marks(["an-address"])
    assert not mark.refuses
    assert "daq did not answer, which drives nothing" in mark.in_words()

    monkeypatch.setattr(bench.plan.instruments[0].driver, "make_safe", refuse)
    assert bench.plan.instruments[0].role != "daq"
    assert act(bench.order(), "a test")["safe"] is False


def test_an_earlier_guards_report_is_not_taken_for_this_ones(bench: Bench) -> None:
    earlier = bench.order(journal="yesterday.rigj", safe=True, file="yesterday.h5", failures={})
    bench.report.write_text(json.dumps(earlier))
    link = GuardLink(bench.plan, bench.journal, bench.report)
    assert link.trouble() is None
    link._process.kill()
    link._process.wait(PATIENCE_S)
    assert link.trouble() == "has died"
    link.beat()  # tells nobody, and ends nothing
    assert link.take_over() == (False, "the guard did not report: it ended with code -9", False)


@pytest.mark.thorough
def test_a_report_that_cannot_be_written_keeps_no_data_back(bench: Bench) -> None:
    report = act(bench.order(report=str(bench.report / "no" / "such" / "folder.json")), "a test")
    assert report["safe"] is True
    assert "not compiled" in report["file"]
    assert bench.outputs()[-1][0] is False


def test_what_does_not_answer_is_tried_again_for_a_while_and_what_did_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def part(role: str, tries: int) -> Any:
        def make_safe(settings: object) -> None:
            asked.append(role)
            if asked.count(role) < tries:
                raise InstrumentError(role, "stop", "no answer", "switch it on")

        driver = SimpleNamespace(make_safe=make_safe)
        return SimpleNamespace(role=role, driver=driver, settings=SimpleNamespace(timeout_s=1.0))

    parts = part("generator", 1), part("stage_z", 3)
    described = SimpleNamespace(instruments=parts, failures={})
    monkeypatch.setattr("rig.bench.plan.parse_to_make_safe", lambda *_: described)
    monkeypatch.setattr("rig.run.making_safe.guard.AGAIN_EVERY_S", 0.01)
    made = make_bench_safe("", "bench.toml", again_s=PATIENCE_S)
    assert made.safe
    assert made.failures == {}
    assert asked == ["generator", "stage_z", "stage_z", "stage_z"]

"""Running the program as its users do, the real command line in a process of its own; and skins of
the reference case, built once for all workers."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import one_thread  # noqa: F401 - before NumPy
import pytest
from benches import DECLARED_CONTACT, Bench, declare_soft_contact
from compiled_kernels import ensure_compiled
from forked_rig import ForkedProcess, environment, server
from hypothesis import settings

from rig.bench.plan import read_bench
from rig.core.cache import DiskCache
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import SkinTrial, SlideSettings, slide
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.lock import address_names
from rig.run.locks.shared_folder import VARIABLE as SHARED_FOLDER

settings.register_profile("any computer", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("any computer")
"""A loaded machine is no failure: wall-clock bounds live in benchmarks. The examples are the same
in every run, so that many of them find no more the second time."""

RIG_MAIN = "from rig.cli import main; main()"
RIG = [sys.executable, "-c", RIG_MAIN]
SIMULATING = ("sweep", "slip-trial", "roll-trial", "jog", "simulate")
"""Commands that simulate a bench where they are given none."""
PATIENCE_S = 120.0
GUARD_PATIENCE_S = 30.0


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels before there are workers, so that no two of them compile the same.

    Locks and marks of benches go to a folder of this test run, never to that of the computer."""
    shared = tempfile.mkdtemp(prefix="rig-tests-shared-")
    os.environ[SHARED_FOLDER] = shared
    config.add_cleanup(lambda: shutil.rmtree(shared, ignore_errors=True))
    # Under nohup, commands that a test starts would inherit an ignored SIGHUP.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)
    if not hasattr(config, "workerinput") and not config.option.collectonly:
        ensure_compiled()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep the garbage collector from what imports and collection have made, some million objects:
    it would look through all of them again and again, and tests that call it waited for it."""
    gc.freeze()


@dataclass
class Finished:
    """A command that has ended."""

    code: int
    stdout: str
    stderr: str

    @property
    def object(self) -> dict[str, Any]:
        """What ``--json`` printed."""
        return json.loads(self.stdout)

    @property
    def errors(self) -> list[str]:
        """The lines on stderr that report errors."""
        return [line for line in self.stderr.splitlines() if line.startswith("error: ")]


class Running:
    """A command that is running; its stderr can be waited for line by line."""

    def __init__(self, process: subprocess.Popen[str] | ForkedProcess, name: str):
        self.process = process
        self.name = name
        self._lines: list[str] = []
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def wait_for(self, pattern: str) -> str:
        """Wait until a line of stderr matches; the line."""
        deadline = time.monotonic() + PATIENCE_S
        seen = 0
        while True:
            with self._news:
                for line in self._lines[seen:]:
                    if re.search(pattern, line):
                        return line
                seen = len(self._lines)
                if not self._reader.is_alive() or time.monotonic() > deadline:
                    raise AssertionError(f"no line {pattern!r} in:\n" + "".join(self._lines))
                self._news.wait(0.2)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the command."""
        self.process.send_signal(number)

    def send_as_the_terminal_does(self, number: signal.Signals) -> None:
        """Send a signal to every process of the command's group, which is its own."""
        assert os.getpgid(self.process.pid) == self.process.pid, "never to this program's group"
        os.killpg(self.process.pid, number)

    def finish(self) -> Finished:
        """Wait for the end."""
        assert self.process.stdout is not None
        stdout = self.process.stdout.read()
        code = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return Finished(code, stdout, "".join(self._lines))

    def reported(self, state: str) -> str:
        """What it is, its `state` and exit code, and its stderr."""
        self._reader.join(PATIENCE_S)
        lines = "".join(self._lines)
        return f"rig {self.name} {state}, exit code {self.process.returncode}; stderr:\n{lines}"

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._news:
                self._lines.append(line)
                self._news.notify_all()


class Rig:
    """The command ``rig`` in a folder of its own; benches that it simulates are like `bench`."""

    def __init__(self, folder: Path, bench: Bench | None = None):
        self.folder = folder
        self.bench = bench
        self.usual_ways = False
        """Whether z goes as slowly where it has not been as on a bench whose file declares nothing;
        otherwise simulated benches declare the contact that there is (decision 0117)."""
        self.results = folder / "results"
        self.world_log = folder / "world.jsonl"
        self.env = environment()
        self.shared = folder / "shared"
        self.env[SHARED_FOLDER] = str(self.shared)
        self.serving: Running | None = None
        """The latest bench that ran by itself (`served`)."""
        self._started: list[Running] = []

    def on_bench(self, *arguments: str) -> list[str]:
        """A command's arguments, with stages and DAQ for a bench that it simulates where they do
        not choose them."""
        given = list(arguments)
        named = "--bench" in given or (
            given[0] != "simulate" and (self.folder / "bench.toml").exists()
        )
        if given[0] not in SIMULATING or named:
            return given
        if self.bench is not None and "--stages" not in given:
            given += ["--stages", self.bench.stages]
        if (self.bench is not None or not self.usual_ways) and "--world" not in given:
            given += ["--world", self.world("")]
        return given

    def command(self, *arguments: str) -> list[str]:
        """The whole command line, for whoever starts it by other means."""
        return [*RIG, *self.on_bench(*arguments)]

    def start(self, *arguments: str, before: str = "", fresh: bool = False) -> Running:
        """Start a command in a process of its own.

        The process is forked from one that has imported already. Where the test is about the start,
        with `fresh`, and where the environment was changed for Python itself, it is a new one.
        `before` is Python that a new process runs first, to have something go wrong in it.
        """
        given = self.on_bench(*arguments)
        process: subprocess.Popen[str] | ForkedProcess
        if fresh or before or server().imported_otherwise(self.env):
            process = subprocess.Popen(
                [sys.executable, "-c", f"{before}\n{RIG_MAIN}", *given],
                cwd=self.folder,
                env=self.env,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                process_group=0,  # as a shell starts it; a terminal's signals reach it alone
            )
        else:
            process = server().start(given, self.folder, self.env)
        running = Running(process, given[0])
        self._started.append(running)
        return running

    def run(self, *arguments: str) -> Finished:
        """Run a command to its end."""
        return self.start(*arguments).finish()

    def sweep(self, *arguments: str) -> Finished:
        """A sweep on the slaved simulated bench, with its World's log, without a figure."""
        return self.run(*self.sweep_arguments(*arguments))

    def start_sweep(self, *arguments: str) -> Running:
        """The same, started."""
        return self.start(*self.sweep_arguments(*arguments))

    def sweep_arguments(self, *arguments: str) -> list[str]:
        """Arguments of such a sweep."""
        log = ["--world-log", str(self.world_log)]
        return ["sweep", "--json", "--no-figures", *log, *arguments]

    @contextlib.contextmanager
    def served(self, *options: str, ways: str = "quick") -> Iterator[Path]:
        """A simulated bench that runs by itself, in real time; its bench file, ``bench.toml``.

        It declares a contact so soft that no speed is too large, unless `ways` is "as usual", which
        takes 12 s: for tests that are about them."""
        self.usual_ways = self.usual_ways or ways == "as usual"
        path = self.folder / "bench.toml"
        log = ("--world-log", str(self.world_log))
        self.serving = serving = self.start("simulate", "--write", str(path), *log, *options)
        serving.wait_for("Ctrl-C ends it")
        if ways == "quick":
            declare_soft_contact(path)
        yield path
        serving.send(signal.SIGINT)
        ended = serving.finish()
        assert ended.code == 0, ended.stderr

    def fault(self, text: str) -> str:
        """Write a fault plan; its path."""
        path = self.folder / "fault.toml"
        path.write_text(text)
        return str(path)

    def world(self, text: str) -> str:
        """Write World settings, with the bench's DAQ where they name none, and with the contact
        that lets z go quickly where it has not been; their path."""
        path = self.folder / "world.toml"
        own = ""
        if self.bench is not None and "daq_model" not in text:
            own += f'daq_model = "{self.bench.daq}"\n'
        if not self.usual_ways and DECLARED_CONTACT not in text:
            own += DECLARED_CONTACT
        path.write_text(own + text)
        return str(path)

    def log(self) -> list[dict[str, Any]]:
        """The World's log so far; a line that is being written is not yet one."""
        whole, _, _ = self.world_log.read_text().rpartition("\n")
        return [json.loads(line) for line in whole.splitlines()]

    def outputs(self) -> list[bool]:
        """Every state the generator's output went through, in order."""
        return [entry["value"] for entry in self.log() if entry["what"] == "ch1.on"]

    def await_world(self, what: str, value: object = None, count: int = 1) -> None:
        """Wait until the World's log says that `what` has happened so often."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            log = self.log() if self.world_log.exists() else []
            seen = sum(x["what"] == what and value in (None, x["value"]) for x in log)
            if seen >= count:
                return
            time.sleep(0.05)
        raise AssertionError(f"the World's log never said {what}")

    def guard_report(self) -> dict[str, Any] | None:
        """The guard's last word, once it has compiled; None where it has not said it in time."""
        deadline = time.monotonic() + GUARD_PATIENCE_S
        while time.monotonic() < deadline:
            beside_the_run, of_the_bench = "*.guard.json", "guard-*.json"
            for path in (*self.results.rglob(beside_the_run), *self.results.glob(of_the_bench)):
                report: dict[str, Any] = json.loads(path.read_text())
                if "file" in report:
                    return report
            time.sleep(0.05)
        return None

    def marks(self) -> list[dict[str, Any]]:
        """The marks that runs have left on benches, one for each address."""
        return [json.loads(path.read_text()) for path in self.shared.glob("*.mark")]

    def mark_unsafe(self, bench_file: Path, failures: dict[str, str]) -> None:
        """Mark a bench as one that an earlier run could not make safe."""
        plan = read_bench(bench_file)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(SHARED_FOLDER, str(self.shared))
            BenchMarks(address_names(plan), plan.settings.name, None).unsafe(failures)

    def mark_running(self, bench_file: Path) -> None:
        """Mark a bench as one on which this process is at work, without a guard."""
        plan = read_bench(bench_file)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(SHARED_FOLDER, str(self.shared))
            BenchMarks(address_names(plan), plan.settings.name, None).running(0)

    def only(self, pattern: str) -> Path:
        """The one file below the results folder that matches."""
        (path,) = self.results.rglob(pattern)
        return path

    def close(self) -> None:
        """End what a test left running, and print what every command said: a test that fails shows
        it."""
        for running in self._started:
            ended = running.process.poll() is not None
            if not ended:
                running.process.kill()
                running.process.wait()
            print(running.reported("ended" if ended else "was left running"))


@pytest.fixture
def bench() -> Bench | None:
    """What every bench that a command simulates is like; None: the command's own."""
    return None


@pytest.fixture(scope="module")
def rig_of_the_module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """The command line in a folder that the tests of a module share."""
    made = Rig(tmp_path_factory.mktemp("made"))
    yield made
    made.close()


@pytest.fixture
def rig(tmp_path: Path, bench: Bench | None) -> Iterator[Rig]:
    """The command line, in an empty folder."""
    made = Rig(tmp_path, bench)
    yield made
    made.close()


@pytest.fixture
def usual_ways(rig: Rig) -> None:
    """Let z go where it has not been as on a bench whose file declares no contact, for tests that
    are about the way or count from its start: a short sweep takes twice the bench time, a slip
    trial a quarter more."""
    rig.usual_ways = True


@pytest.fixture(scope="session")
def skin_cache(tmp_path_factory: pytest.TempPathFactory) -> DiskCache:
    """One cache of skins for all workers; it lives as long as the test run."""
    base = tmp_path_factory.getbasetemp()
    return DiskCache((base.parent if base.name.startswith("popen-") else base) / "skin-cache")


@pytest.fixture(scope="session")
def skin6(skin_cache: DiskCache) -> CondensedSkin:
    """The reference skin at 6 elements a ridge."""
    return build_skin(SkinSettings(elements_per_ridge=6), skin_cache)


@pytest.fixture(scope="session")
def skin8(skin_cache: DiskCache) -> CondensedSkin:
    """The reference skin at 8 elements a ridge."""
    return build_skin(SkinSettings(), skin_cache)


@pytest.fixture(scope="session")
def reference_slide(skin8: CondensedSkin) -> SkinTrial:
    """The reference slide with its contact forces."""
    return slide(skin8, SlideSettings(), keep_forces=True)

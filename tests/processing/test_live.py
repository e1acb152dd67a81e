"""A detector beside a running trial: it never delays the caller, and a broken one is dropped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import recorded_trials as trials
from packages import install
from tiers import mostly_thorough

from rig.core.errors import RigError
from rig.detector.events import SlipEvent
from rig.detector.notices import XMove
from rig.detector.registered import chosen_detector
from rig.processing import live

T = TypeVar("T")
RATE_Hz = 1000.0
PATIENCE_S = 120.0
"""Beside busy processes the child, which is niced, may get little of a processor."""
LEVEL = '''"""A level detector."""
import os
import numpy as np
from rig.core.settings import Settings
from rig.detector.contract import Detector


class LevelSettings(Settings):
    level_mV: float = 20.0


class Level(Detector):
    """Reports each row in which |v_d| passes a level upwards."""

    Settings, version = LevelSettings, "3"

    def reset(self):
        self.above = True

    def judge(self, volts):
        found = []
        for row, v_d in enumerate(volts[:, 0] - volts[:, 1]):
            above = 1e3 * abs(v_d) > self.settings.level_mV
            if above and not self.above:
                found.append(self.event("incipient slip", row, 0.75, self.say()))
            self.above = above
        return found

    def say(self):
        return ""
'''


SAY = 'return ""'
SAID = """print("x")
        return f"{os.getpid()} {os.nice(0)} {sorted(os.listdir('/proc/self/fd'))}\"
"""


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Install the level detector for processes that are started, some of its text replaced."""

    def made(*instead: tuple[str, str]) -> None:
        source = LEVEL
        for old, new in instead:
            assert old in source
            source = source.replace(old, new)
        install(
            tmp_path / "site",
            "lab-level",
            "[rig.detectors]\nlab-level = lab.level:Level\n",
            {"lab/__init__.py": "", "lab/level.py": source},
        )
        monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))

    return made


@pytest.fixture
def started(lab: Callable[..., None]) -> Iterator[Callable[..., live.LiveDetector]]:
    """Start a detector that is closed after the test."""
    running: list[live.LiveDetector] = []

    def one(name: str = "lab-level", **options: object) -> live.LiveDetector:
        running.append(live.start(name, RATE_Hz, **options))  # type: ignore[arg-type]
        return running[-1]

    yield one
    for each in running:
        each.close()


def blocks(volts: np.ndarray, rows: int = 2) -> Iterator[tuple[np.ndarray, int]]:
    for first in range(0, len(volts), rows):
        yield volts[first : first + rows], first


def until(what: Callable[[], T]) -> T:
    end_s = time.monotonic() + PATIENCE_S
    while not (found := what()):
        assert time.monotonic() < end_s, "nothing came"
        time.sleep(0.005)
    return found


def crossing() -> np.ndarray:
    """0.2 s of nothing, and then three passages of 20 mV."""
    volts = np.zeros((500, 2))
    for begin in (200, 300, 400):
        volts[begin : begin + 20, 0] = 0.05
    return volts


def session_of(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if os.getsid(int(entry.name)) == pid and state != "Z":
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def test_a_detector_of_this_project_finds_beside_a_trial_what_it_finds_in_the_file(
    started: Callable[..., live.LiveDetector],
) -> None:
    volts = trials.slipping()
    detector = chosen_detector("paper-hp").make(RATE_Hz)
    expected = [*detector.add(volts), *detector.finish()]
    woken: list[int] = []
    one = started("paper-hp", woken=lambda: woken.append(1))
    for _ in range(2):  # two recordings
        one.begin()
        for part, first in blocks(volts):
            one.add(part, first)
        one.finish()
        found = one.take()
        assert [each.event for each in found] == expected
        assert all(each.latency_s >= 0 for each in found)
    assert len(woken) >= 2
    assert one.dropped() is None
    assert one.identity.package == "tactile-rig"


@pytest.mark.parametrize("patient", [True, False])
def test_one_of_another_package_runs_in_a_process_of_its_own(
    lab: Callable[..., None], started: Callable[..., live.LiveDetector], patient: bool
) -> None:
    lab((SAY, SAID))
    with open("/dev/null") as held:  # noqa: PTH123 - as a bench's lock: open in the run
        assert held
        # A busy computer must not drop it here.
        one = started(patient=patient, longest_lag_s=PATIENCE_S, settings='{"level_mV": 30.0}')
    assert one.identity.settings == '{"level_mV":30.0}'
    assert (one.identity.package, one.identity.version) == ("lab-level", "3")
    rows = []
    for _ in range(2):
        one.begin()
        for part, first in blocks(crossing()):
            one.add(part, first)
            if not patient and first % 100 == 0:
                one.settle(PATIENCE_S)  # more than its socket holds would drop it as late
        found = one.take()
        while len(found) < 3:
            assert not patient
            assert one.in_use, one.dropped()
            found += until(one.take)
        rows.append([each.event.sample for each in found])
        for each in found:
            assert each.latency_s > 0
            pid, niceness, descriptors = each.event.reason.split(maxsplit=2)
            assert int(pid) != os.getpid()
            assert int(niceness) >= 10
            # stdin, stdout, stderr, the socket, and the listing's own.
            assert len(descriptors.split(",")) == 5, descriptors
    assert rows == [[200, 300, 400]] * 2
    assert one.dropped() is None
    process = one._process  # type: ignore[attr-defined]
    assert len(session_of(process.pid)) == 2
    one.close()
    until(lambda: session_of(process.pid) == [])
    assert one.dropped() is None


def test_a_command_reaches_one_of_another_package_at_its_row(
    lab: Callable[..., None], started: Callable[..., live.LiveDetector]
) -> None:
    heard = "    x = 0.0\n\n    def commanded(self, before, after):\n        self.x = after\n\n"
    lab((SAY, "return str(self.x)"), ("    def say", heard + "    def say"))
    one = started(patient=True)
    one.begin()
    for part, first in blocks(crossing(), 50):
        if first == 200:
            one.notice(XMove(250, -0.5, 350))
        one.add(part, first)
    found = [(each.event.sample, each.event.reason) for each in one.take()]
    assert found == [(200, "0.0"), (300, "-0.5"), (400, "0.0")]
    assert one.dropped() is None


DROPPED = {
    "raises": (SAY, "1 / 0", "line 30: ZeroDivisionError: division by zero)"),
    "ends": (SAY, "os._exit(3)", "ended (exit code 3)"),
    "crashes": (SAY, "os.kill(os.getpid(), 11)", "ended (SIGSEGV)"),
    "sleeps": (SAY, "__import__('time').sleep(1000)", "fell behind by "),
    "hangs in C code": (SAY, "__import__('re').match('(a+)+$', 'a' * 50 + 'b')", "fell behind by "),
    "forks": (SAY, "os.fork(); return ''", "gave no usable answer (an answer to nothing"),
    "is stopped": (SAY, "os.kill(os.getpid(), 19)", "fell behind by "),
    "writes to the socket": (
        SAY,
        "[os.write(int(fd), b'x') for fd in os.listdir('/proc/self/fd') if int(fd) > 2 and "
        "os.path.exists(f'/proc/self/fd/{fd}') and "
        "os.readlink(f'/proc/self/fd/{fd}').startswith('socket')]; return ''",
        "gave no usable answer (",
    ),
    "asks for most of the free memory": (
        SAY,
        "free = next(one for one in open('/proc/meminfo') if one.startswith('MemAvailable')); "
        "np.empty(int(free.split()[1]) * 3 // 4 * 128); return ''",
        "MemoryError",
    ),
    "sees the future": ('"incipient slip", row', '"incipient slip", row + 9', "but rows "),
    "reports without end": (
        "        return found",
        "        return found * 300",
        "returned 300 events",
    ),
}


@pytest.mark.parametrize(
    "fault",
    mostly_thorough(
        DROPPED, default=("raises", "hangs in C code", "forks", "asks for most of the free memory")
    ),
)
def test_one_that_fails_is_dropped_and_nobody_waits_for_it(
    lab: Callable[..., None], started: Callable[..., live.LiveDetector], fault: str
) -> None:
    old, new, reason = DROPPED[fault]
    lab((old, new))
    falls_behind = reason.startswith("fell behind")
    one = started(longest_lag_s=0.3 if falls_behind else PATIENCE_S)
    one.begin()
    begun_s = time.monotonic()
    for part, first in blocks(np.tile(crossing(), (40, 1))):  # 10 000 blocks: more than fit
        one.add(part, first)
        if not falls_behind:
            one.settle(PATIENCE_S)  # on a busy computer a full socket would drop it as late
        elif first < 1000 and one.in_use:
            time.sleep(0.001)
    assert time.monotonic() - begun_s < PATIENCE_S
    said = until(one.dropped)
    assert isinstance(said, str)
    assert reason in said
    assert said.startswith("detector lab-level of the package lab-level ")
    assert said.endswith(": no longer used")
    assert one.dropped() is None, "one warning"
    process = one._process  # type: ignore[attr-defined]
    until(lambda: not session_of(process.pid))
    one.add(crossing(), 20_000)
    one.finish()
    assert not one.in_use


@pytest.mark.thorough
def test_a_patient_one_that_hangs_is_dropped_and_signs_of_life_are_given_meanwhile(
    lab: Callable[..., None],
    started: Callable[..., live.LiveDetector],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lab((SAY, "__import__('time').sleep(1000)"))
    monkeypatch.setattr(live, "PATIENCE_S", 3.0)
    beats: list[float] = []
    one = started(patient=True, beat=lambda: beats.append(time.monotonic()))
    one.begin()
    begun_s = time.monotonic()
    for part, first in blocks(crossing()):
        one.add(part, first)
    assert "fell behind by " in until(one.dropped)
    assert len(beats) >= 3, "a busy computer gives fewer than 15"
    assert time.monotonic() - begun_s < PATIENCE_S


RUN = """
import sys, time
import numpy as np
from rig.processing import live
one = live.start("lab-level", 1000.0, longest_lag_s=1000.0)
one.begin()
one.add(np.array([[0.0, 0.0], [1.0, 0.0]]), 0)
print(one._process.pid, flush=True)
time.sleep(1000)
"""


def test_it_ends_with_the_run_also_where_it_hangs(lab: Callable[..., None]) -> None:
    lab((SAY, "os.fork(); __import__('re').match('(a+)+$', 'a' * 50 + 'b')"))
    run = subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True)
    try:
        assert run.stdout is not None
        pid = int(run.stdout.readline())
        until(lambda: len(session_of(pid)) == 3)  # the watching one, the detector, its child
    finally:
        run.kill()
        run.wait()
    until(lambda: session_of(pid) == [])


DAEMON = """
import os, sys, time
if os.fork():
    os._exit(0)
os.setsid()
if os.fork():
    os._exit(0)
with open(sys.argv[1] + ".new", "w") as file:
    file.write(str(os.getpid()))
os.rename(sys.argv[1] + ".new", sys.argv[1])
time.sleep(1000)
"""
STARTS = """import subprocess, sys
        subprocess.run([sys.executable, "-c", {daemon!r}, {noted!r}])
        while not os.path.exists({noted!r}):
            pass
        return str(1 // {divisor})"""


@pytest.mark.parametrize("divisor", [1, 0], ids=["closed", "dropped"])
def test_a_process_that_has_left_its_session_ends_with_it(
    lab: Callable[..., None],
    started: Callable[..., live.LiveDetector],
    tmp_path: Path,
    divisor: int,
) -> None:
    """A server that a detector's package starts, for example one that draws, outlives no run."""
    noted = tmp_path / "pid"
    lab((SAY, STARTS.format(daemon=DAEMON, noted=str(noted), divisor=divisor)))
    one = started(longest_lag_s=PATIENCE_S)
    one.begin()
    one.add(crossing()[:201], 0)
    until(noted.exists)
    if divisor:
        until(one.take)
        one.close()
    else:
        assert "ZeroDivisionError" in until(one.dropped)
    until(lambda: not Path(f"/proc/{noted.read_text()}").exists())


@pytest.mark.parametrize(
    ("name", "instead", "reason"),
    [
        ("lab-none", (SAY, SAY), "detector 'lab-none' is unknown; choose a detector among "),
        ("lab-level", ("import os\n", "import acme_sdk\n"), "install acme_sdk, which the package"),
        ("lab-level", ("import os\n", "import os; os._exit(0)\n"), "its process ended (exit code"),
        (
            "lab-level",
            ('"3"\n', '"3"\n    fastest_Hz = design_rate_Hz = 700.0\n'),
            "",
        ),
    ],
    ids=["unknown", "broken", "ends at import", "another rate"],
)  # fmt: skip
def test_one_that_cannot_be_used_is_refused_before_anything_moves(
    lab: Callable[..., None],
    started: Callable[..., live.LiveDetector],
    name: str,
    instead: tuple[str, str],
    reason: str,
) -> None:
    lab(instead)
    if not reason:  # it is resampled
        one = started(name, patient=True)
        one.begin()
        one.add(crossing(), 0)
        assert len(one.take()) == 3
        return
    with pytest.raises(RigError) as refused:
        started(name)
    assert reason in refused.value.one_line()


def test_a_detector_of_this_project_that_raises_is_dropped_too(
    started: Callable[..., live.LiveDetector],
) -> None:
    one = started("paper-hp")
    one.begin()
    one.add(np.full((1, 2), np.nan), 0)
    said = one.dropped()
    assert said is not None
    assert "v_1 is nan V at sample 0" in said
    one.add(crossing(), 1)
    assert one.take() == []
    with pytest.raises(RigError, match="between 500 and 50000 Hz"):
        live.start("paper-hp", 100.0)


def test_a_large_block_arrives_whole(
    lab: Callable[..., None], started: Callable[..., live.LiveDetector]
) -> None:
    lab()
    one = started(patient=True)
    volts = np.tile(crossing(), (40, 1))
    one.begin()
    one.add(volts, 0)
    found: list[SlipEvent] = [each.event for each in one.take()]
    assert len(found) == 120
    assert signal.getsignal(signal.SIGPIPE) is not None

"""A bench without a run in the terminal: its instruments are read, and nothing is moved or set."""

from __future__ import annotations

import itertools
import re
import signal
import time
from collections.abc import Callable
from io import StringIO

import pytest
from rich.console import Console

from rig.bench.plan import BenchPlan, InstrumentPlan, read_bench
from rig.bench.settings import BenchSettings, FixtureSettings
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.core.settings import Settings
from rig.instruments.roles import Identity, StageStatus
from rig.page import live_links
from rig.page.live_bench import panel
from rig.page.live_links import Silence, StageLink, come, reading


def test_a_sensor_that_always_has_something_new_is_left_for_the_next_drawing():
    assert set(come(lambda: 1)) == {1}
    left = [2, 1]
    assert list(come(lambda: left.pop() if left else None)) == [1, 2]


class StagesModule:
    """A driver's module whose reader fails at first, then shows a stage that moves once."""

    def __init__(self, failures: int = 0):
        self.failures = failures
        self.opened = self.closed = 0
        self.read_at_s: list[float] = []

    def open_reader(self, settings: object, clock: object) -> StagesModule:
        """Return itself as the reader."""
        self.opened += 1
        if self.opened <= self.failures:
            raise InstrumentError("stage_z", "identify", "no answer", "switch it on")
        return self

    timeout_s = 0.5
    identity = Identity("ACME", "Z", "SIM1", "1")

    def read(self) -> StageStatus:
        """Return that the stage moves."""
        self.read_at_s.append(time.monotonic())
        return StageStatus(12.3456, True, "on", True, "")

    def close(self) -> None:
        """Count."""
        self.closed += 1


def stage_link(module: StagesModule, silence: Silence, role: str = "stage_z") -> StageLink:
    """Return a link to a stage of that driver."""
    return StageLink(InstrumentPlan(role, "acme", module, Settings()), silence)  # type: ignore[arg-type]


def shown(links: list[StageLink], unreadable: list[str]) -> str:
    """What a terminal of 80 columns shows of the links."""
    plan = BenchPlan(
        BenchSettings(name="b", fixture=FixtureSettings(mounted="film-clamp")), (), "", "b.toml"
    )
    text = StringIO()
    Console(file=text, width=80).print(panel(plan, links, unreadable))
    return text.getvalue()


def until(holds: Callable[[], bool]) -> None:
    """Wait until something holds."""
    give_up_s = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < give_up_s, "it has never come to hold"
        time.sleep(0.01)


def test_while_a_stage_moves_the_drives_are_left_alone_for_longer_than_their_timeout():
    """Readings restart the time-out of a drive: one whose program has died has to stop all the
    same."""
    now_s = [0.0]
    silence = Silence(lambda: now_s[0])
    silence.begin()
    assert silence.left_s() == 0, "no drive has a time-out"
    silence.note_timeout("rotary", 0.0)
    silence.note_timeout("stage_z", 1.0)
    silence.note_timeout("stage_x", 4.0)
    silence.begin()
    now_s[0] = 4.0
    assert silence.left_s() > 0
    now_s[0] = 5.0
    assert silence.left_s() == 0
    assert silence.retry_s > 4.0


def test_a_stage_that_moves_is_read_again_only_after_its_drives_timeout():
    module, silence = StagesModule(), Silence()
    link = stage_link(module, silence)
    with reading([link]):
        until(lambda: len(module.read_at_s) >= 3)
    gaps_s = [b - a for a, b in itertools.pairwise(module.read_at_s)]
    assert min(gaps_s) > module.timeout_s, gaps_s
    assert module.closed == module.opened == 1


def test_a_link_that_fails_says_so_and_is_opened_anew_while_the_others_go_on(monkeypatch):
    monkeypatch.setattr(live_links, "RETRY_S", 1.0)
    broken, sound = StagesModule(failures=1), StagesModule()
    z = stage_link(broken, Silence())
    x = stage_link(sound, Silence(), "stage_x")
    with reading([z, x]):
        until(lambda: bool(z.failure) and x.status is not None)
        text = " ".join(shown([z, x], ["rotary"]).split())
        assert "stage_z cannot be read: stage_z: identify: no answer" in text
        assert "stage_x 12.3456 mm homed on moves none" in text
        assert "rotary: position not offered by its driver" in text
        until(lambda: z.status is not None)
        text = " ".join(shown([z, x], []).split())
        assert "cannot be read" not in text
        assert "stage_z 12.3456 mm homed on moves none" in text


def stages_shown(text: str) -> dict[str, tuple[float, str, str, str]]:
    """Position, reference, motion and fault of each stage in the latest drawing."""
    line = re.compile(
        r"^(stage_z|stage_x|rotary) +(-?[\d.]+) (?:mm|deg) +(not homed|homed) +"
        r"(?:on|off|ready|not ready|STOP is set) +(at rest|moves) +(\S+)",
        re.MULTILINE,
    )
    return {m[1]: (float(m[2]), m[3], m[4], m[5]) for m in line.finditer(text)}


@pytest.mark.thorough
def test_without_a_run_positions_are_the_worlds_and_nothing_is_moved_set_or_left_behind(rig):
    """All three kinds of stage, homed and left by a program; a monitor that is killed leaves them
    as they were, and so does one that ends."""
    with rig.served("--fixture", "semi-spherical-object", "--stages", "festo-az") as path:
        plan = read_bench(path)
        for part in plan.instruments:
            if part.role in live_links.STAGE_UNITS:
                stage = part.driver.connect(part.settings, WallClock())
                stage.home()
                stage.close()
        for fault in (391, 0x85):  # both drives stop by their communication time-out
            rig.await_world("fault", fault)
        killed = rig.start("monitor", "--bench", str(path))
        rig.await_world("streaming", True)
        before = len(rig.log())
        time.sleep(2.0)  # it reads on
        killed.send(signal.SIGKILL)
        killed.finish()
        watched = rig.start("monitor", "--bench", str(path), "--seconds", "6")
        rig.await_world("streaming", True, count=2)
        refused = rig.run("roll-trial", "--bench", str(path))
        assert (refused.code, "is in use by" in refused.stderr) == (2, True)
        ended = watched.finish()
        happened = rig.log()[before:]
    assert ended.code == 0, ended.stderr
    for text in ("SIMULATED", "force z", "strip_1"):
        assert text in ended.stdout
    at_rest = {entry["device"]: entry["value"] for entry in rig.log() if entry["what"] == "at-rest"}
    found = stages_shown(ended.stdout)
    assert set(found) == set(at_rest) == set(live_links.STAGE_UNITS)
    stopped_by_itself = {"stage_z": "391", "stage_x": "85h", "rotary": "none"}
    for role, (position, *state) in found.items():
        assert abs(position - at_rest[role]) < 1e-3, role
        assert state == ["homed", "at rest", stopped_by_itself[role]], role
    assert {entry["device"] for entry in happened} <= {"force_sensor", "daq"}, happened


@pytest.mark.thorough
@pytest.mark.parametrize("stopped", [False, True], ids=["at work", "stopped"])
def test_make_safe_ends_a_monitor_which_may_have_a_serial_port_for_itself(rig, stopped):
    """One that does not end by itself is killed."""
    with rig.served("--fixture", "semi-spherical-object", "--stages", "az") as path:
        watched = rig.start("monitor", "--bench", str(path))
        rig.await_world("streaming", True)
        if stopped:
            watched.send(signal.SIGSTOP)
        safe = rig.run("make-safe", "--bench", str(path))
        ended = watched.finish()
    assert safe.code == 0, safe.stderr
    assert f"ended rig monitor (process {watched.process.pid})" in safe.stderr
    assert "stage_z, stage_x, rotary" in safe.stderr
    assert ended.code in ((-9,) if stopped else (143, -9))  # a busy computer may let it not end
    if ended.code == 143:
        assert "ended by SIGTERM" in ended.stderr

"""Trials on the simulated bench: what is drawn, and how they are made, stored and resumed."""

import importlib
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.world.plate_world import HeadWorldSettings
from procedures.path_trial.settings import PathTrialSettings
from procedures.roll_trial.settings import RollTrialSettings
from procedures.slip_trial.settings import SlipTrialSettings
from rig.core.cache import DiskCache
from rig.detector.notices import XMove
from rig.evaluation.scoring.outcomes import Truth
from rig.evaluation.wire import making
from rig.evaluation.wire.kinds import WIRE_KINDS, Limit, WireKind, drawn
from rig.evaluation.wire.record import WireRecord, pack, unpack

SETTINGS = {
    "slip-trial": SlipTrialSettings,
    "path-trial": PathTrialSettings,
    "roll-trial": RollTrialSettings,
}
LIMIT = Limit(way_mm=0.2)


@pytest.mark.parametrize("kind", WIRE_KINDS)
def test_what_is_drawn_are_settings_that_a_procedure_accepts(kind: WireKind):
    for seed in range(40):
        trial = drawn(kind, seed, LIMIT)
        settings = SETTINGS[trial.procedure].model_validate(trial.settings)
        assert 0.5 <= settings.normal_force_N <= 12.0
        assert 50 <= settings.tick_Hz <= 500
        assert trial == drawn(kind, seed, LIMIT)


def test_the_kinds_of_a_seed_share_the_world_and_another_seed_has_another():
    trials = {kind: drawn(kind, 7, LIMIT) for kind in WIRE_KINDS}
    world = trials["slide"].world
    for kind, trial in trials.items():
        rolls = {"head": trial.world["head"]} if kind.startswith("roll") else {}
        assert trial.world == {**world, **rolls}
    assert drawn("slide", 8, None).world != world


def test_every_seed_is_another_bench():
    worlds = [drawn("roll a", seed, None).world for seed in range(40)]
    assert len({world["skin"]["youngs_modulus_MPa"] for world in worlds}) == 40
    assert {world["skin"]["strips"]["offset_mm"] for world in worlds} == {
        0.25,
        0.3,
        0.35,
        0.4,
        0.45,
    }
    assert len({world["skin_mount"]["gain_mismatch"] for world in worlds}) == 40
    assert len({world["head"]["body"]["radius_mm"] for world in worlds}) == 40
    for world in worlds:
        HeadWorldSettings.model_validate(world)


@pytest.mark.parametrize("seed", range(10))
def test_a_hold_goes_to_60_to_98_percent_of_the_way_to_slip_and_stays(seed: int):
    settings = PathTrialSettings.model_validate(drawn("hold", seed, LIMIT).settings)
    ends_mm = settings.path_positions_mm[-1]
    assert 0.6 <= abs(ends_mm) / LIMIT.way_mm <= 0.98
    assert max(map(abs, settings.path_positions_mm)) == abs(ends_mm)
    assert settings.stay_s >= 0.4


@pytest.mark.parametrize("seed", range(10))
def test_a_re_grip_in_a_slide_grips_about_where_the_ridge_slips_and_slides_on(seed: int):
    trial = drawn("re-grip in a slide", seed, LIMIT)
    settings = PathTrialSettings.model_validate(trial.settings)
    ends_mm = abs(settings.path_positions_mm[-1])
    assert ends_mm == pytest.approx(2 * LIMIT.way_mm, abs=1e-6)
    grips_s, gripped_s, _ = settings.force_times_s[1:]
    slips_s = LIMIT.way_mm / float(trial.traits["speed_mm_s"])
    assert 0.9 * slips_s - 1e-4 <= grips_s <= 1.1 * slips_s + 0.05 + 1e-4
    assert gripped_s - grips_s == pytest.approx(0.005)
    assert 1.1 <= settings.force_shares[-1] <= 1.4


def test_a_soft_stop_takes_its_speed_back_in_steps():
    softs = [t for s in range(20) if (t := drawn("hold", s, LIMIT)).traits["stop"] == "soft"]
    path = np.abs(np.column_stack([softs[0].settings["path_times_s"],
                                   softs[0].settings["path_positions_mm"]]))  # fmt: skip
    speeds = np.diff(path[:, 1]) / np.diff(path[:, 0])
    assert len(speeds) == 7
    assert (np.diff(speeds) < 0).all()


def test_a_record_is_stored_with_all_that_is_scored():
    record = _record()
    again = unpack(pack(record))
    assert again is not None
    assert repr(again.truth) == repr(record.truth)  # NaN is not equal to NaN
    assert np.allclose(again.volts, record.volts, atol=1e-9)
    assert (again.way_mm, again.tick_from_s, again.traits) == (0.2, 0.5, {"kind": "slide"})
    assert again.notices == (XMove(500, -0.25, 700),)
    assert unpack(b"something else") is None


def _record() -> WireRecord:
    truth = Truth("slip", 0.5, 0.6, 0.7, 0.8, record_s=1.0, quiet_s=((0.1, 0.5),))
    volts = 1e-3 * np.random.default_rng(0).standard_normal((1000, 2))
    moves = (XMove(500, -0.25, 700),)
    return WireRecord(volts, 1000.0, truth, 0.2, 0.5, {"kind": "slide"}, notices=moves)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A command `rig` that writes down its arguments, sleeps and answers as its files say."""
    command = tmp_path / "rig"
    command.write_text(
        "#!/bin/sh\n"
        f'echo "$@" >> {tmp_path}/calls\n'
        f"[ -e bench.toml ] && touch {tmp_path}/real\n"
        f'trap "echo stopped >> {tmp_path}/calls; exit 143" TERM\n'
        f"[ -e {tmp_path}/slow ] && {{ sleep 60 >&- 2>&- & wait; }}\n"
        f"cat {tmp_path}/answer\n"
        f"exit $(cat {tmp_path}/code)\n"
    )
    command.chmod(0o755)
    answers(tmp_path, 0, {"file": "some.h5", "errors": []})
    monkeypatch.setattr(making, "rig_command", lambda: command)
    monkeypatch.setattr(making, "read_record", lambda path: _record())
    return tmp_path


def answers(bench: Path, code: int, said: dict) -> None:
    (bench / "code").write_text(str(code))
    (bench / "answer").write_text(json.dumps(said))


def made(bench: Path, *kinds: WireKind, jobs: int = 2) -> list[making.MadeTrial]:
    cache = DiskCache(bench / "cache")
    found = making.make_trials(kinds, [3, 4], cache, jobs, lambda *_: None)
    return sorted(found, key=lambda one: one.trial.name)


def calls(bench: Path) -> list[str]:
    file = bench / "calls"
    return file.read_text().splitlines() if file.exists() else []


def test_each_trial_is_made_once_by_its_command_with_its_world_and_seed(bench: Path):
    first = made(bench, "slide", "ramp")
    assert [one.trial.name for one in first] == ["ramp 3", "ramp 4", "slide 3", "slide 4"]
    assert len(calls(bench)) == 4
    assert all(line.startswith("slip-trial --results ") for line in calls(bench))
    assert sum(" --seed 3 " in line for line in calls(bench)) == 2
    assert sum(" --loading=ramp" in line for line in calls(bench)) == 2
    again = made(bench, "slide", "ramp")
    assert len(calls(bench)) == 4, "they are in the cache"
    assert [one.trial for one in again] == [one.trial for one in first]


def test_a_bench_file_in_the_present_folder_is_never_used(
    bench: Path, monkeypatch: pytest.MonkeyPatch
):
    """A command without --bench takes ./bench.toml: it would press and slide on a real bench."""
    (bench / "bench.toml").write_text("")
    monkeypatch.chdir(bench)
    assert all(one.record is not None for one in made(bench, "slide"))
    assert len(calls(bench)) == 2
    assert not (bench / "real").exists()


def test_a_hold_comes_after_the_slide_that_shows_how_far_it_may_go(bench: Path):
    (hold, *_) = made(bench, "hold")
    assert [line.split()[0] for line in calls(bench)].count("slip-trial") == 2
    ends_mm = abs(hold.trial.settings["path_positions_mm"][-1])
    assert 0.6 <= ends_mm / 0.2 <= 0.98


def test_a_trial_whose_bench_has_died_is_made_again(bench: Path):
    said = {"file": None, "errors": ["simulated bench: start: the process ended at once"]}
    answers(bench, 3, said)
    assert [one.record for one in made(bench, "slide")] == [None, None]
    answers(bench, 0, {"file": "some.h5", "errors": []})
    assert all(one.record is not None for one in made(bench, "slide"))


def test_a_trial_that_ends_at_a_limit_is_stored_as_failed_and_one_that_was_killed_is_not(
    bench: Path,
):
    answers(bench, 4, {"file": None, "errors": ["force 15.2 N is above 15 N"]})
    (failed, _) = made(bench, "slide")
    assert failed.record is None
    assert failed.failed == "exit code 4: force 15.2 N is above 15 N"
    assert len(calls(bench)) == 2
    assert made(bench, "slide")[0].failed == failed.failed
    assert len(calls(bench)) == 2
    answers(bench, 1, {"file": None, "errors": ["disk full"]})
    assert made(bench, "ramp")[0].record is None
    answers(bench, 0, {"file": "some.h5", "errors": []})
    assert made(bench, "ramp")[0].record is not None


def test_a_hold_without_a_known_limit_says_so_and_is_not_made(bench: Path):
    answers(bench, 4, {"file": None, "errors": ["too much"]})
    (hold, _) = made(bench, "hold")
    assert hold.failed.startswith("no way to slip is known: exit code 4")
    assert len(calls(bench)) == 2


def test_ctrl_c_ends_the_commands_under_way_in_order(bench: Path):
    (bench / "slow").touch()

    def interrupt() -> None:
        deadline = time.monotonic() + 20
        while len(calls(bench)) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    waiter = threading.Thread(target=interrupt)
    # Tests that run in the background have it ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        waiter.start()
        with pytest.raises(KeyboardInterrupt):
            made(bench, "slide")
        waiter.join()
    finally:
        signal.signal(signal.SIGINT, before)
    assert calls(bench).count("stopped") == 2
    (bench / "slow").unlink()
    assert all(one.record is not None for one in made(bench, "slide"))


def test_the_key_of_a_trial_depends_on_all_that_was_drawn_and_on_the_code(monkeypatch):
    trial = drawn("slide", 1, None)
    key = making.key_of(trial)
    assert making.key_of(drawn("slide", 2, None)) != key
    monkeypatch.setattr(making, "code_digest", lambda: "other code")
    assert making.key_of(trial) != key


@pytest.mark.parametrize(
    "module",
    ["rig.analysis.trial.decimation", "rig.run.execute", "rig.bench.connect", "rig.core.clock"],
)
def test_the_code_of_a_trial_is_all_that_has_a_part_in_its_record(monkeypatch, module):
    file = Path(importlib.import_module(module).__file__)
    now, read = making.code_digest(), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"# other" * (path == file))
    assert making.code_digest.__wrapped__() != now

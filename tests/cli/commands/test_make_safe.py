"""`rig make-safe` acts whatever is wrong around the instruments, and says so."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest
import typer

from rig.bench.plan import read_bench
from rig.cli.commands.make_safe import make_safe
from rig.core.errors import ExitCode
from rig.run.locks import bench_users
from rig.run.locks.bench_mark import made_safe_ns
from rig.run.locks.lock import address_names
from rig.run.making_safe.guard import MadeSafe

BENCH = """
name = "b"
[fixture]
mounted = "film-clamp"
[generator]
driver = "keysight-33500b"
resource = "TCPIP0::127.0.0.1::5025::SOCKET"
max_amplitude_V = 5.0
"""


@pytest.fixture
def acted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The benches that were made safe; the generator answers."""
    made: list[str] = []

    def act(_: str, source: str) -> MadeSafe:
        made.append(source)
        return MadeSafe()

    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    monkeypatch.setattr("rig.run.making_safe.guard.make_bench_safe", act)
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(BENCH)
    return made


def ended() -> ExitCode:
    """Run the command; its exit code."""
    try:
        make_safe(Path("bench.toml"))
    except typer.Exit as end:
        return ExitCode(end.exit_code)
    return ExitCode.DONE


def fail(*_: object) -> NoReturn:
    raise UnicodeDecodeError("utf-8", b"\xc3", 0, 1, "unexpected end of data")


@pytest.mark.parametrize("part", ["end_readers", "ask_users", "take_turn"])
def test_whatever_fails_before_it_the_instruments_are_made_safe(acted, monkeypatch, part) -> None:
    """The name of a process may end within a character, for instance."""
    monkeypatch.setattr("rig.run.locks.lock.names_in_use", lambda _: "it is in use")
    monkeypatch.setattr(bench_users, part, fail)
    monkeypatch.setattr(bench_users, "names_in_use", lambda _: None)
    assert ended() == ExitCode.DONE
    assert acted == ["bench.toml"]


@pytest.mark.parametrize(
    "part", ["rig.run.locks.lock.address_names", "rig.run.locks.bench_users.read_marks"]
)
def test_where_it_is_not_known_who_uses_the_bench_it_is_not_called_safe(
    acted, monkeypatch, capfd, part
) -> None:
    monkeypatch.setattr(part, fail)
    assert ended() == ExitCode.UNSAFE
    assert acted == ["bench.toml"]
    *_, made_safe, last = capfd.readouterr().err.splitlines()
    assert made_safe == "b: generator made safe"
    assert last.startswith("error: NOT SAFE: everything was stopped, but another program (")


def test_its_success_is_noted_for_who_shows_the_state_and_a_failure_is_not(
    acted, monkeypatch, capfd
) -> None:
    (name,) = address_names(read_bench(Path("bench.toml")))
    failed = MadeSafe({"generator": "it does not answer"}, False)
    monkeypatch.setattr("rig.run.making_safe.guard.make_bench_safe", lambda *_: failed)
    assert ended() == ExitCode.UNSAFE
    assert made_safe_ns([name]) is None
    monkeypatch.setattr("rig.run.making_safe.guard.make_bench_safe", lambda *_: MadeSafe())
    assert ended() == ExitCode.DONE
    assert made_safe_ns([name]) is not None
    monkeypatch.setattr("rig.run.locks.bench_mark.note_made_safe", fail)
    assert ended() == ExitCode.DONE
    assert made_safe_ns([name]) is None
    assert "warning: " in capfd.readouterr().err


def test_the_batch_of_a_run_is_ended_and_not_only_the_run(acted, monkeypatch, tmp_path) -> None:
    """Its supervisor would have another worker take the run again."""
    asked = tmp_path / "asked"

    def ask_users(_, requests) -> None:
        requests.runs.add(tmp_path / "night" / "runs" / "r00001_sweep.rigj")

    def ask_batch(batch: Path, request: str) -> None:  # in a process of its own
        asked.write_text(f"{request} {batch}")

    in_use = ["it is in use"]
    monkeypatch.setattr("rig.run.locks.lock.names_in_use", lambda _: in_use[0])
    monkeypatch.setattr(bench_users, "names_in_use", lambda _: None)
    monkeypatch.setattr(bench_users, "ask_users", ask_users)
    monkeypatch.setattr("rig.batch.running.batch_of", lambda journal: journal.parent.parent)
    monkeypatch.setattr("rig.batch.running.ask_batch", ask_batch)
    assert ended() == ExitCode.DONE
    assert asked.read_text() == f"stop-now {tmp_path / 'night'}"


@pytest.mark.parametrize(
    "text", ["[generator", "name = 5", None], ids=["syntax", "empty", "folder"]
)
def test_a_file_that_cannot_be_used_is_said_to_have_made_nothing_safe(acted, capfd, text) -> None:
    if text is None:
        Path("bench.toml").unlink()
        Path("bench.toml").mkdir()
    else:
        Path("bench.toml").write_text(text)
    assert ended() == ExitCode.USAGE
    assert acted == []
    last = capfd.readouterr().err.splitlines()[-1]
    assert last.startswith("error: nothing was made safe: ")
    assert "switch the bench off by hand" in last


def test_a_fault_beside_the_instruments_does_not_say_that_the_bench_has_to_be_switched_off(
    acted, monkeypatch, capfd
) -> None:
    """An instrument may be missing because its table is misspelled, so it is not called safe."""

    def act(_: str, source: str) -> MadeSafe:
        acted.append(source)
        return MadeSafe({"bench file": f"{source}: fixture.mountd: unknown key"}, False)

    monkeypatch.setattr("rig.run.making_safe.guard.make_bench_safe", act)
    Path("bench.toml").write_text(BENCH.replace("mounted", "mountd"))
    assert ended() == ExitCode.UNSAFE
    assert acted == ["bench.toml"]
    *_, last = capfd.readouterr().err.splitlines()
    assert last.startswith("error: NOT SAFE: every instrument that bench.toml names was made safe")
    assert last.endswith("correct the file, then run this command again")

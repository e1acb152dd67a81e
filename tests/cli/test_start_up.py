"""What a person meets first: help that comes at once and says what there is."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import typer
from tiers import mostly_thorough

from rig.cli.app import COMMANDS, GROUPS, build
from rig.core.entry_points import PROCEDURES, names

EXPENSIVE = ("scipy", "numpy", "h5py", "matplotlib", "pint", "pydantic", "pyvisa", "numba")
PROGRAM = f"""
import sys
sys.argv[0] = "rig"
from rig.cli import main
try:
    main()
finally:
    print("imported:", *[m for m in {EXPENSIVE!r} if m in sys.modules], file=sys.stderr)
"""


def rig(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("arguments", [("--help",), ()])
def test_help_imports_nothing_expensive(arguments: tuple[str, ...]) -> None:
    shown = rig(*arguments)
    assert shown.stderr.splitlines()[-1] == "imported:", shown.stderr
    assert "Usage: " in shown.stdout + shown.stderr


def test_a_command_line_that_cannot_be_parsed_is_one_sentence_of_its_object() -> None:
    refused = rig("show", "--json")
    (error,) = json.loads(refused.stdout)["errors"]
    assert error == "Missing argument 'FILE'; see rig --help"


def test_help_lists_every_procedure_with_its_summary_and_every_command() -> None:
    shown = " ".join(rig("--help").stdout.split())
    for entry in entry_points(group="rig.procedures"):
        first_line = (entry.load().__doc__ or "").split("\n", 1)[0]
        assert first_line.rstrip(".")[:40] in shown
        assert f" {entry.name} " in shown
    for command in (
        *("resume", "show", "verify", "recover", "import", "detect", "filter"),
        *("simulate", "make-safe", "skin", "jog"),
    ):
        assert f" {command} " in shown
    assert "simulated bench" in shown


def test_a_procedures_help_shows_its_settings_with_units_and_defaults() -> None:
    shown = " ".join(rig("sweep", "--help").stdout.split())
    for words in (
        "--load N",
        "[default: 1 N; above 0]",
        "--preload N",
        "[default: 25 N; above 0]",
        "--settling s",
        "--dry-run",
        "--json",
    ):
        assert words in shown
    assert "2 to 20000 Hz" in shown


def commands_of(name: str) -> dict[str, Any]:
    """Return the command, or the commands of the group, by what is typed for it."""
    command: Any = typer.main.get_command(build([name])).commands[name]  # type: ignore[attr-defined]
    subcommands = getattr(command, "commands", {})
    return {name: command} | {f"{name} {sub}": subcommands[sub] for sub in subcommands}


@pytest.mark.parametrize("name", [*COMMANDS, *GROUPS, *names(PROCEDURES)])
def test_help_names_only_options_that_the_command_has(name: str) -> None:
    for typed, command in commands_of(name).items():
        own = {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
        texts = [command.help or "", *(getattr(one, "help", None) or "" for one in command.params)]
        for text in texts:
            of_this = re.sub(r"\brig [a-z-]+( [a-z-]+)? --[a-z-]+", "", text)  # those of others
            assert set(re.findall(r"--[a-z][a-z-]*", of_this)) <= own, f"rig {typed}: {text}"


def test_help_of_the_skin_imports_nothing_expensive() -> None:
    """But pydantic, which typer itself needs for options with types."""
    for arguments in (("skin", "--help"), ("skin", "slide", "--help")):
        shown = rig(*arguments)
        imported = shown.stderr.splitlines()[-1].split()[1:]
        assert set(imported) <= {"pydantic"}, shown.stderr
        assert "slide" in shown.stdout


@pytest.mark.parametrize(
    "trial", mostly_thorough(["slip-trial", "roll-trial", "path-trial"], ["slip-trial"])
)
def test_help_of_a_trial_imports_nothing_expensive(trial: str) -> None:
    shown = rig(trial, "--help")
    imported = shown.stderr.splitlines()[-1].split()[1:]
    assert set(imported) <= {"pydantic"}, shown.stderr
    assert "--normal-force" in shown.stdout


def test_a_command_that_does_not_exist_is_a_usage_error() -> None:
    shown = rig("swoop")
    assert shown.returncode == 2
    assert "swoop" in shown.stderr
    assert "Traceback" not in shown.stderr


def test_output_that_cannot_be_written_is_reported_and_no_success() -> None:
    with Path("/dev/full").open("w") as full:
        shown = subprocess.run(
            [sys.executable, "-c", PROGRAM, "--help"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert shown.returncode == 1
    assert "could not be written to stdout: No space left on device" in shown.stderr


STOPS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT]


def help_with(preparation: str) -> subprocess.CompletedProcess[str]:
    """Run ``rig --help`` in a process of its own after some statements."""
    program = f"{preparation}\nsys.argv = ['rig', '--help']\nfrom rig.cli import main\nmain()\n"
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize("number", mostly_thorough(STOPS, [signal.SIGTERM]))
def test_a_signal_while_python_waits_for_a_thread_ends_the_command_without_a_complaint(
    number: signal.Signals,
) -> None:
    ended = help_with(
        "import os, sys, threading, time\n"
        "def stop():\n"
        "    threading.main_thread().join()\n"
        "    time.sleep(1)\n"  # Python is then surely in the wait for this thread
        f"    os.kill(os.getpid(), {number.value})\n"
        "    time.sleep(3600)\n"
        "threading.Thread(target=stop).start()"
    )
    assert ended.returncode == 128 + number
    assert ended.stderr == ""
    assert "Usage: rig" in ended.stdout


@pytest.mark.parametrize("number", mostly_thorough(STOPS, [signal.SIGINT]))
def test_a_signal_while_python_clears_up_does_not_change_the_exit_code(
    number: signal.Signals,
) -> None:
    ended = help_with(
        f"import atexit, os, sys\natexit.register(os.kill, os.getpid(), {number.value})"
    )
    assert ended.returncode == 0
    assert ended.stderr == ""
    assert "Usage: rig" in ended.stdout


def test_under_nohup_a_terminal_that_closes_ends_no_command() -> None:
    ended = help_with(
        "import os, signal, sys\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "import rig.cli.app as app\n"
        "perform = app.perform\n"
        "app.perform = lambda given: (os.kill(os.getpid(), signal.SIGHUP), perform(given))"
    )
    assert ended.returncode == 0
    assert "Usage: rig" in ended.stdout


def test_every_command_and_group_is_listed_with_its_description() -> None:
    listed = " ".join(rig("--help").stdout.split())
    docstrings = {name: import_module(module).__doc__ for name, module in GROUPS.items()}
    for name, (module, function) in COMMANDS.items():
        docstrings[name] = getattr(import_module(module), function).__doc__
    for name, docstring in docstrings.items():
        text = (docstring or "").split("\n", 1)[0]
        assert f" {name} {text[:30]}" in listed


@pytest.mark.thorough
def test_processes_that_are_started_take_no_modules_from_where_they_are_started(
    tmp_path: Path,
) -> None:
    """Bench, guard and figure are processes of their own; somebody's folder ``rig`` is not ours."""
    for name in ("rig", "drivers"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('not this one')\n")
    program = Path(sys.executable).with_name("rig")
    ended = subprocess.run(
        [str(program), "sweep", "--frequencies", "200"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "the guard has died" not in ended.stderr
    assert list((tmp_path / "results").glob("*/*.png")), "and the figure is there"

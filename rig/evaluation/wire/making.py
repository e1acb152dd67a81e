"""Makes the trials on the simulated bench, several at a time, and stores what they recorded.

Each trial is one command, `rig slip-trial` or another procedure, in a process of its own with a
simulated bench of its own: the way in which a person makes it. What it recorded is stored under a
key of everything that determines it: what was drawn, the seed, and the program's code that makes
and records it. A run that was interrupted continues where it stopped.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from rig.core.cache import Cache
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.settings import option_name
from rig.evaluation.wire.kinds import Limit, WireKind, WireTrial, drawn, needs_limit
from rig.evaluation.wire.record import WireRecord, pack, read_record, unpack

Read = TypeVar("Read")

FORMAT = 4
"""Raised when what is stored changes its meaning."""
CODE = (
    "drivers",
    "procedures",
    "rig.analysis",
    "rig.bench",
    "rig.control",
    "rig.core",
    "rig.files.journal",
    "rig.files.runfile",
    "rig.instruments",
    "rig.physics",
    "rig.run",
)
"""Packages whose code determines what a trial records: also the decimation of v_1 and v_2, the way
to the instruments, the clock, and what the file keeps."""
LONGEST_S = 580.0
"""Time after which a command that makes a trial has failed; the longest takes a tenth of it on a
free processor."""
REASON_CHARACTERS = 200
"""Length to which the reason of a failed trial is cut."""


@dataclass(frozen=True)
class MadeTrial:
    """A trial and its record, or why it has none."""

    trial: WireTrial
    record: WireRecord | None
    failed: str = ""
    """Reason for which it could not be made."""


def key_of(trial: WireTrial) -> str:
    """Return the key under which the record of a trial is stored."""
    what = {
        "procedure": trial.procedure,
        "settings": trial.settings,
        "world": trial.world,
        "seed": trial.seed,
    }
    digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:24]
    return f"wire-trial-{FORMAT}-{digest}-{code_digest()}"


@lru_cache(maxsize=1)
def code_digest() -> str:
    """Return a digest of the code that determines what a trial records (`CODE`)."""
    digest = hashlib.sha256()
    for package in CODE:
        found = importlib.util.find_spec(package)
        assert found is not None
        assert found.submodule_search_locations is not None
        (folder,) = map(Path, found.submodule_search_locations)
        for file in sorted(folder.rglob("*.py")):
            digest.update(str(file.relative_to(folder)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:24]


def stored(trial: WireTrial, cache: Cache) -> MadeTrial | None:
    """Return a trial that was made before; None if it has to be made."""
    content = cache.get(key_of(trial))
    if content is None:
        return None
    if content.startswith(_FAILED):
        return MadeTrial(trial, None, content[len(_FAILED) :].decode())
    record = unpack(content)
    return None if record is None else MadeTrial(trial, record)


_FAILED = b"failed: "


@dataclass
class TrialCommands:
    """Runs commands, and ends those that are under way."""

    running: set[subprocess.Popen[str]] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)
    ended: bool = False

    def run(self, command: Sequence[str], folder: str) -> tuple[int, str, str]:
        """Return exit code, stdout and stderr of a command that works in a folder.

        The folder must have no bench file: where the present one has a ``bench.toml``, the command
        would move a real bench. Raises KeyboardInterrupt once the commands have been ended.
        """
        with self.lock:
            if self.ended:
                raise KeyboardInterrupt
            # A session of its own: Ctrl-C is for this process, which ends the commands in order.
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                text=True, start_new_session=True, cwd=folder,
            )  # fmt: skip
            self.running.add(process)
        try:
            out, err = process.communicate(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            process.kill()
            out, err = process.communicate()
        finally:
            with self.lock:
                self.running.discard(process)
        return process.returncode, out, err

    def end(self) -> None:
        """End what runs, in order, and begin nothing more. SIGTERM, because a command that was
        started in the background ignores SIGINT."""
        with self.lock:
            self.ended = True
            for process in self.running:
                with suppress(OSError):
                    process.send_signal(signal.SIGTERM)


def make_trials(
    kinds: Sequence[WireKind],
    seeds: Sequence[int],
    cache: Cache,
    jobs: int,
    done: Callable[[int, int, int], None],
) -> Iterator[MadeTrial]:
    """Yield the trials of these kinds and seeds as they are made, in no order; those that are in
    the cache come first. `done` is called with the number so far, of all, and of those that had to
    be made.

    Trials that need the way to slip come after the slide of their seed. An interruption ends the
    commands under way; what was made before is in the cache.
    """
    bench, total = TrialCommands(), len(kinds) * len(seeds)
    slides: dict[int, MadeTrial] = {}
    number = made = 0
    with ThreadPoolExecutor(jobs) as pool:
        under_way: dict[Future[MadeTrial], tuple[WireKind, int]] = {}
        try:
            waiting = [(kind, seed) for seed in seeds for kind in _in_order(kinds)]
            while waiting or under_way:
                held: list[tuple[WireKind, int]] = []
                for kind, seed in waiting:
                    if needs_limit(kind) and seed not in slides:
                        held.append((kind, seed))
                        continue
                    trial, reason = _trial_of(kind, seed, slides.get(seed))
                    one = MadeTrial(trial, None, reason) if reason else stored(trial, cache)
                    if one is None:
                        if len(under_way) >= jobs:
                            held.append((kind, seed))
                            continue
                        under_way[pool.submit(_make, trial, cache, bench)] = kind, seed
                        continue
                    if kind == "slide":
                        slides[seed] = one
                    if kind in kinds:
                        number += 1
                        done(number, total, made)
                        yield one
                progressed = len(held) < len(waiting)
                waiting = held
                if under_way and (not progressed or len(under_way) >= jobs):
                    ended, _ = wait(under_way, return_when=FIRST_COMPLETED)
                    for future in ended:
                        kind, seed = under_way.pop(future)
                        one = future.result()
                        made += 1
                        if kind == "slide":
                            slides[seed] = one
                        if kind in kinds:
                            number += 1
                            done(number, total, made)
                            yield one
        finally:
            bench.end()


def _in_order(kinds: Sequence[WireKind]) -> list[WireKind]:
    """Return the kinds with the slide first if any of them needs it."""
    first: list[WireKind] = ["slide"] if "slide" in kinds or any(map(needs_limit, kinds)) else []
    return first + [kind for kind in kinds if kind != "slide"]


def _trial_of(kind: WireKind, seed: int, slide: MadeTrial | None) -> tuple[WireTrial, str]:
    """Return a trial, and why it cannot be made if it cannot."""
    if not needs_limit(kind):
        return drawn(kind, seed, None), ""
    assert slide is not None
    if slide.record is None or slide.record.way_mm is None:
        why = slide.failed or "the slide of this seed did not slip"
        return drawn(kind, seed, Limit(0.1)), f"no way to slip is known: {why}"
    return drawn(kind, seed, Limit(slide.record.way_mm)), ""


def _make(trial: WireTrial, cache: Cache, bench: TrialCommands) -> MadeTrial:
    """Make a trial and store its record, or why there is none."""
    record, reason, lasting = make_one(trial, bench, read_record)
    # A command that was killed, whose disk was full or whose bench has died, which is a failure of
    # an instrument (3), says nothing of the trial: made again later.
    if record is not None:
        cache.put(key_of(trial), pack(record))
    elif lasting:
        cache.put(key_of(trial), _FAILED + reason.encode())
    return MadeTrial(trial, record, reason)


def make_one(
    trial: WireTrial, bench: TrialCommands, read: Callable[[Path], Read]
) -> tuple[Read | None, str, bool]:
    """Make a trial by a command of its own and return what `read` reads from its run file; if there
    is nothing, the reason, and whether the same trial would fail again.

    KeyboardInterrupt once `bench` has ended.
    """
    with tempfile.TemporaryDirectory(prefix="rig-score-") as folder:
        # Absolute and new, so that no bench file of the user's is in it (see TrialCommands.run).
        folder = str(Path(folder).resolve())
        world = Path(folder) / "world.toml"
        world.write_text(_toml(trial.world), encoding="utf-8")
        code, out, err = bench.run(
            [
                str(rig_command()), trial.procedure, "--results", folder, "--world", str(world),
                "--seed", str(trial.seed), "--no-figures", "--json", *_options(trial.settings),
            ],
            folder,
        )  # fmt: skip
        if bench.ended:
            raise KeyboardInterrupt
        try:
            file = json.loads(out)["file"] if code in (0, 5) else None
            found = read(Path(file)) if file else None
            reason = "" if found is not None else _reason(code, out, err)
        except (ValueError, KeyError) as error:
            found, reason = None, str(error)[:REASON_CHARACTERS]
    return found, reason, code == ExitCode.LIMIT


def _reason(code: int, out: str, err: str) -> str:
    """Return why a command has made no trial."""
    with suppress(ValueError, KeyError):
        errors = json.loads(out)["errors"]
        if errors:
            return f"exit code {code}: {errors[0]}"[:REASON_CHARACTERS]
    words = [line for line in err.splitlines() if line.startswith("error")] or err.splitlines()
    return f"exit code {code}: {words[-1] if words else ''}"[:REASON_CHARACTERS]


def rig_command() -> Path:
    """Return the command `rig` of this environment. Raises ConfigurationError where there is
    none."""
    command = Path(sys.executable).with_name("rig")
    if not os.access(command, os.X_OK):
        raise ConfigurationError(
            f"--wire: no command rig beside {sys.executable}",
            "install this project",
        )
    return command


def _options(settings: dict[str, Any]) -> list[str]:
    """Return settings as the options of a command: negative numbers need the form with =, and a
    switch has no value."""
    return [
        option_name(name) if value is True else f"{option_name(name)}={_text(value)}"
        for name, value in settings.items()
    ]


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_text, value))
    return repr(value) if isinstance(value, float) else str(value)


def _toml(tables: dict[str, Any], name: str = "") -> str:
    """Return nested tables of numbers as TOML."""
    plain = [f"{key} = {value!r}" for key, value in tables.items() if not isinstance(value, dict)]
    text = "\n".join(([f"[{name}]"] if name else []) + plain) + "\n"
    for key, value in tables.items():
        if isinstance(value, dict):
            text += _toml(value, f"{name}.{key}".lstrip("."))
    return text

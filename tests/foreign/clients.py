"""Other people's clients in environments of their own, and a server for them to talk to."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import pytest

from drivers.simulated.ports import Excitation

REPOSITORY = Path(__file__).parents[2]


def _uv() -> str:
    own = REPOSITORY / ".uv" / "bin" / "uv"
    found = str(own) if own.exists() else shutil.which("uv")
    if found is None:
        pytest.skip("uv is needed to make a foreign environment")
    return found


def python_with(name: str, requirements: list[str]) -> str:
    """The interpreter of an environment under `.venv-foreign/`, made on first use.

    Needs the package index that first time.
    """
    environment = REPOSITORY / ".venv-foreign" / name
    python = environment / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    made_from, wanted = environment / "made-from", " ".join([sys.version, *requirements])
    if not made_from.exists() or made_from.read_text() != wanted:
        make = [_uv(), "venv", "--quiet", "--clear", "--python", sys.executable]
        subprocess.run([*make, str(environment)], check=True)
        install = [_uv(), "pip", "install", "--quiet", "--python", str(python)]
        subprocess.run([*install, *requirements], check=True)
        made_from.write_text(wanted)
    return str(python)


def seen_by(python: str, script: str, *arguments: str) -> Any:
    """What a script prints last, as JSON; its error output when it fails."""
    done = subprocess.run(
        [python, "-c", script, *arguments], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


class Server(Protocol):
    """What is in front of a simulated instrument, whatever its transport."""

    async def start(self) -> None:
        """Begin to listen."""
        ...

    async def close(self) -> None:
        """Stop listening."""
        ...


@contextmanager
def serving(server: Server) -> Iterator[None]:
    """The server's event loop in a thread."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        asyncio.run_coroutine_threadsafe(server.start(), loop).result(10)
        yield
    finally:
        asyncio.run_coroutine_threadsafe(server.close(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@dataclass
class Terminals:
    """Records what a generator puts out."""

    now_us: int = 0
    excitations: list[tuple[int, Excitation]] = field(default_factory=list)

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        self.excitations.append((channel, excitation))

    def log(self, device: str, what: str, value: object, by: str) -> None:
        pass

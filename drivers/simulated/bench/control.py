"""The simulated bench's control socket: one JSON line asks, one JSON line answers.

    {"do": "advance", "us": 10000}      -> {"now_us": ..., "streams": {name: bytes sent}}
    {"do": "point", "run": 0, "point": 7} -> {"now_us": ...}
    {"do": "weigh", "force_N": [0, 0, 5]} -> {"now_us": ...}: puts weights on the sensors
    {"do": "truth"}                     -> {"now_us": ..., ...}: what really happened
    {"do": "stop"}                      -> {"now_us": ...}, and the bench ends

Where the World has failed, the next advance says so, and every point or truth asked for does; other
advances go on, for the bench has still to be brought to rest.

The first connection owns a slaved World's time. When it closes without a stop, its owner has died:
the World continues in real time, for the drives' time-outs and for the guard, and ends some time
later.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from typing import Any, cast

from drivers.simulated.world.world import World

LONGEST_ADVANCE_US = 1_000_000


class ControlServer:
    """Serves the control socket of one World on 127.0.0.1."""

    def __init__(
        self,
        world: World,
        streams: Mapping[str, Callable[[], int]],
        stop: Callable[[], None],
        orphaned: Callable[[], None],
        set_free: Callable[[], None],
        time_passed: Callable[[], None] = lambda: None,
    ):
        self._world = world
        self._streams = streams
        self._stop = stop
        self._orphaned = orphaned
        self._set_free = set_free
        self._time_passed = time_passed
        self._server: asyncio.Server | None = None
        self._owned = False
        self._stopped = False
        self._failure_reported = False

    async def start(self, port: int = 0) -> int:
        """Listen; returns the port."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Peer(self), "127.0.0.1", port)
        return int(self._server.sockets[0].getsockname()[1])

    def close(self) -> None:
        """Stop listening and close the connections."""
        if self._server is not None:
            self._server.close()

    def answer(self, line: bytes) -> dict[str, Any]:
        """Return the answer to one request line; an error is an answer too."""
        try:
            request = json.loads(line)
            do = request["do"]
            if do == "advance":
                self._advance(int(request["us"]))
                if self._world.failure is not None and not self._failure_reported:
                    self._failure_reported = True
                    return self._failed()
                sent = {name: count() for name, count in self._streams.items()}
                return {"now_us": self._world.now_us, "streams": sent}
            if do in ("point", "truth") and self._world.failure is not None:
                return self._failed()
            if do == "truth":
                return {"now_us": self._world.now_us, **self._world.truth()}
            if do == "point":
                self._world.announce(int(request["run"]), int(request["point"]))
            elif do == "weigh":
                x, y, z = (float(value) for value in request["force_N"])
                self._world.weigh((x, y, z))
            elif do == "free":
                self._set_free()
            elif do == "stop":
                self._stopped = True
                self._stop()
            else:
                return {"error": f"unknown request {do!r}"}
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            return {"error": f"{type(error).__name__}: {error}"}
        return {"now_us": self._world.now_us}

    def _failed(self) -> dict[str, Any]:
        return {"error": f"the simulated contact has failed {self._world.failure}"}

    def _advance(self, step_us: int) -> None:
        if step_us > LONGEST_ADVANCE_US:
            raise ValueError(f"an advance of {step_us} us is longer than {LONGEST_ADVANCE_US} us")
        self._world.timeline.advance(step_us)
        self._time_passed()

    def connected(self) -> bool:
        """Return whether a new connection is the first, which owns the World's time."""
        first, self._owned = not self._owned, True
        return first

    def lost(self) -> None:
        """Set the time free, because the connection of its owner has closed."""
        if not self._stopped:
            self._orphaned()


class _Peer(asyncio.Protocol):
    """One connection; asyncio sets TCP_NODELAY on it."""

    def __init__(self, server: ControlServer):
        self._server = server
        self._owner = False
        self._received = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._owner = self._server.connected()

    def data_received(self, data: bytes) -> None:
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:  # in the next turn: what instruments were sent before is read in this
            asyncio.get_running_loop().call_soon(self._answer, line)

    def _answer(self, line: bytes) -> None:
        self._transport.write(json.dumps(self._server.answer(line)).encode() + b"\n")

    def connection_lost(self, exc: Exception | None) -> None:
        if self._owner:
            self._server.lost()

"""Faults on the wire between a simulated instrument and its client, as a plan in a TOML file.

This module may decide what becomes of a reply on its way. It may not touch an instrument or a
client: the instrument always receives the request and acts on it, as one does whose answer is lost.

    [[fault]]
    device = "daq"
    kind = "silence"        # garbage, close, truncate, stale
    at = 3                  # the third request that matches
    count = 1               # 0: from then on, for ever
    command = "WAV:DATA"    # only requests with a command that begins so

A new kind is one more function in `_KINDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pydantic import Field, ValidationError

from rig.documents import read_toml
from rig.errors import ConfigurationError
from rig.settings import Settings

FaultKind = Literal["silence", "garbage", "close", "truncate", "stale"]


class Fault(Settings):
    """One disturbance of one device's replies."""

    device: str
    """The device's name in the simulated bench."""
    kind: FaultKind
    """``silence`` loses the reply; ``garbage`` makes it unreadable; ``close`` drops the connection
    instead; ``truncate`` sends its first half; ``stale`` holds it back and sends it in front of
    the connection's next reply."""
    at: int = Field(default=1, ge=1)
    """The first matching request it befalls, counted from 1 over all connections."""
    count: int = Field(default=1, ge=0)
    """How many matching requests it befalls; 0 is for ever."""
    command: str = ""
    """Beginning of a command in the request (upper or lower case, without its leading colon)."""

    def matches(self, request: bytes) -> bool:
        """Whether a command of the request begins as asked."""
        prefix = self.command.encode().upper()
        units = request.upper().split(b";")
        return any(unit.strip().lstrip(b":").startswith(prefix) for unit in units)

    def befalls(self, occurrence: int) -> bool:
        """Whether the n-th matching request is disturbed."""
        return self.at <= occurrence and (self.count == 0 or occurrence < self.at + self.count)


class FaultPlan(Settings):
    """All faults of a simulated bench; empty by default."""

    fault: tuple[Fault, ...] = ()

    @classmethod
    def read(cls, path: Path, devices: Iterable[str] | None = None) -> FaultPlan:
        """The plan in a TOML file; ``devices`` are the names that exist.

        Raises ConfigurationError for an unreadable file, unknown keys, kinds or devices.
        """
        tables = read_toml(path, "fault plan")
        try:
            plan = cls.model_validate(tables)
        except ValidationError as error:
            kinds = ", ".join(get_args(FaultKind))
            hint = f"a fault has device, kind ({kinds}), at, count, command"
            raise ConfigurationError.from_validation(error, str(path), hint) from error
        known = None if devices is None else set(devices)
        for fault in plan.fault:
            if known is not None and fault.device not in known:
                raise ConfigurationError(
                    f"{path}: fault.device = {fault.device!r}: no such device",
                    f"devices are {', '.join(sorted(known))}",
                )
        return plan


@dataclass(frozen=True)
class WireReply:
    """Bytes for the client, and the tag that their exchange was given."""

    data: bytes
    tag: int = 0


@dataclass(frozen=True)
class Delivery:
    """What the server does after a request: send these, in order, then perhaps close."""

    replies: tuple[WireReply, ...] = ()
    close: bool = False


class WireFaults:
    """The faults of one device; counts requests over all its connections."""

    def __init__(self, plan: FaultPlan, device: str):
        self._faults = [fault for fault in plan.fault if fault.device == device]
        self._matched = [0] * len(self._faults)

    def link(self) -> FaultyLink:
        """The faults as one connection meets them."""
        return FaultyLink(self)

    def kind_for(self, request: bytes) -> FaultKind | None:
        """Count a request; the first fault of the plan that befalls it."""
        befallen: FaultKind | None = None
        for index, fault in enumerate(self._faults):
            if fault.matches(request):
                self._matched[index] += 1
                if befallen is None and fault.befalls(self._matched[index]):
                    befallen = fault.kind
        return befallen


class FaultyLink:
    """One connection's exchanges, disturbed as planned."""

    def __init__(self, faults: WireFaults):
        self._faults = faults
        self.withheld: list[WireReply] = []

    def exchange(self, request: bytes, reply: bytes | None, tag: int = 0) -> Delivery:
        """What becomes of a request's reply (None: it has none); ``tag`` comes back with it."""
        kind = self._faults.kind_for(request)
        whole = None if reply is None else WireReply(reply, tag)
        if kind is not None:
            return _KINDS[kind](self, whole)
        if whole is None:
            return Delivery()
        late, self.withheld = self.withheld, []
        return Delivery((*late, whole))


def _silence(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery()


def _garbage(link: FaultyLink, reply: WireReply | None) -> Delivery:
    """Every byte but the last turned over: same length, same end, no ASCII."""
    if reply is None:
        return Delivery()
    spoiled = reply.data[:-1].translate(_TURNED_OVER) + reply.data[-1:]
    return Delivery((WireReply(spoiled, reply.tag),))


def _close(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery(close=True)


def _truncate(link: FaultyLink, reply: WireReply | None) -> Delivery:
    if reply is None:
        return Delivery()
    return Delivery((WireReply(reply.data[: len(reply.data) // 2], reply.tag),))


def _stale(link: FaultyLink, reply: WireReply | None) -> Delivery:
    if reply is not None:
        link.withheld.append(reply)
    return Delivery()


_TURNED_OVER = bytes(byte ^ 0xA5 for byte in range(256))
_KINDS: dict[FaultKind, Callable[[FaultyLink, WireReply | None], Delivery]] = {
    "silence": _silence,
    "garbage": _garbage,
    "close": _close,
    "truncate": _truncate,
    "stale": _stale,
}

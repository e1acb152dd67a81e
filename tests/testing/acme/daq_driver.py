"""ACME AD2, a data acquisition unit on TCP with two inputs."""

from contextlib import closing
from typing import Literal

import numpy as np
from pydantic import Field

from drivers.shared.line_link import LineLink
from rig.core.clock import WallClock
from rig.core.errors import LimitError
from rig.core.settings import Address, Channels, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Identity, Limits, Record, Scaling

ROLES = ("daq",)
INPUTS = ("AI0", "AI1")
RANGES_V = (1.25, 2.5, 5.0, 10.0)
LARGEST_RATE_S_s = 500_000.0
LONGEST = 1000


class Settings(BaseSettings):
    driver: Literal["acme-daq"] = "acme-daq"
    port: Address[str]
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    channels: Channels[dict[str, Literal["AI0", "AI1"]]]


class AD2:
    def __init__(self, settings, clock):
        self._settings, self._clock = settings, clock
        self._link = LineLink("daq", settings.port, settings.timeout_s, clock)
        self.identity = None
        self._wanted = None
        self._next = 0

    def prepare(self):
        found = self._link.ask("ID?", r"(\S+) (\S+) (\S+) (\S+)")
        if found[2] != "AD2":
            raise self._link.error(
                "ID?", f"{self._settings.port} is a {found[1]} {found[2]}", "an AD2 is expected"
            )
        self.identity = Identity(*found.groups())
        self.stop()

    def limits(self):
        limited_by = f"daq {self.identity.model}"
        return {"rate": Limits(1.0, LARGEST_RATE_S_s, "1/s", limited_by)}

    def ranges_V(self):  # noqa: N802
        return RANGES_V

    def check(self, acquisition):
        rate = acquisition.rate_S_s
        self.limits()["rate"].require("daq", "rate", rate)
        for channel in acquisition.channels:
            if channel.range_V not in RANGES_V:
                raise LimitError(f"daq: range {channel.range_V:g} V is none of {RANGES_V} V")
            if channel.name not in self._settings.channels:
                raise LimitError(f"daq: {channel.name} is not wired")

    def acquire(self, acquisition):
        self.start(acquisition)
        self._clock.sleep(acquisition.samples / acquisition.rate_S_s)
        while (record := self.read()) is None:
            self._clock.sleep(0.001)
        self.stop()
        return record

    def start(self, acquisition):
        self.check(acquisition)
        self.stop()
        ranges = dict.fromkeys(INPUTS, RANGES_V[-1])
        for channel in acquisition.channels:
            ranges[self._settings.channels[channel.name]] = channel.range_V
        first, second = ranges.values()
        self._link.ask(f"CONF {acquisition.rate_S_s:.6f} {first} {second}", "OK")
        self._link.ask("RUN", "OK")
        self._wanted, self._next = acquisition, 0
        names = tuple(channel.name for channel in acquisition.channels)
        range_V = tuple(channel.range_V for channel in acquisition.channels)
        none = (0.0,) * len(names)
        steps = tuple(one / 32767 for one in range_V)
        self._scaling = Scaling(
            names, acquisition.rate_S_s, steps, none, range_V, none, -32768, 32767
        )
        return self._scaling

    def read(self):
        wanted = self._wanted
        if int(self._link.ask("CNT?", r"\d+")[0]) < self._next + wanted.samples:
            return None
        text = ""
        for first in range(self._next, self._next + wanted.samples, LONGEST):
            count = min(LONGEST, self._next + wanted.samples - first)
            text += self._link.ask(f"GET {first} {count}", f"[0-9a-f]{{{8 * count}}}")[0]
        both = np.frombuffer(bytes.fromhex(text), "<i2").reshape(-1, 2)
        columns = [INPUTS.index(self._settings.channels[c.name]) for c in wanted.channels]
        record = Record(np.ascontiguousarray(both[:, columns]), self._scaling, self._next)
        self._next += wanted.samples
        return record

    def stop(self):
        self._link.ask("STOP", "OK")

    def make_safe(self):
        self._link.ask("STOP", "OK", charge=False)

    def close(self):
        self._link.close()


def connect(settings, clock):
    daq = AD2(settings, clock)
    try:
        daq.prepare()
    except BaseException:
        daq.close()
        raise
    return daq


def make_safe(settings):
    with closing(AD2(settings, WallClock())) as daq:
        daq.stop()

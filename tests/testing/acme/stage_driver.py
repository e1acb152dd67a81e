"""ACME Z50, a linear stage on TCP."""

import re
from contextlib import closing
from typing import Literal

from pydantic import Field

from drivers.shared.line_link import LineLink
from drivers.shared.stage import StageInterlock, opened, prepared
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.core.settings import Address, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Identity, Limits, StageStatus

ROLES = ("stage_z",)
DEVICE = "stage_z"
STATE = r"(IDLE|MOVE|FAIL) ([01]) (-?\d+\.\d+)"
POLL_S = 0.02
KEEP_ALIVE_S = 0.05
BRAKING_S = 2.0
HOMING_S = 60.0
ARRIVED_mm = 0.005


class Settings(BaseSettings):
    driver: Literal["acme-stage"] = "acme-stage"
    port: Address[str]
    """socket://HOST:PORT"""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    low_limit_mm: float = 0.0
    high_limit_mm: float
    max_speed_mm_s: float = Field(default=10.0, gt=0)
    torque_limit_percent: float = Field(gt=0, le=100)


class Z50:
    def __init__(self, settings, clock):
        self._settings, self._clock = settings, clock
        self._link = LineLink(
            DEVICE, settings.port, settings.timeout_s, clock, resync=("ID?", r"ACME \S+ \S+ \S+")
        )
        self._interlock = StageInterlock(DEVICE)
        self._asked_s = 0.0
        self._target = None
        self.identity = None

    def prepare(self):
        self.identity = self.identify()
        self.stop_and_wait()
        limit = f"{self._settings.torque_limit_percent:.1f}"
        self._link.ask(f"TORQUE {limit}", "OK")
        self._link.ask("TORQUE?", re.escape(limit))

    def identify(self):
        found = self._link.ask("ID?", r"(\S+) (\S+) (\S+) (\S+)")
        vendor, model, number, firmware = found.groups()
        if (vendor, model) != ("ACME", "Z50"):
            raise self._link.error(
                "ID?",
                f"{self._settings.port} is a {vendor} {model}",
                "an ACME Z50 is expected; correct [stage_z] in the bench file",
            )
        return Identity(vendor, model, number, firmware)

    def limits(self):
        own, limited_by = self._settings, f"{DEVICE} {self.identity.model}"
        return {
            "position": Limits(own.low_limit_mm, own.high_limit_mm, "mm", limited_by),
            "speed": Limits(0.001, own.max_speed_mm_s, "mm/s", limited_by),
            "update_rate": Limits(0.0, 100.0, "Hz", limited_by),
        }

    def homed(self):
        return self._state()[1]

    def home(self):
        ticket = self._interlock.ticket()
        self._interlock.permit(ticket, "home")
        self._target = None
        self._link.ask("HOME", "OK", permit=lambda: self._interlock.permit(ticket, "home"))
        give_up = self._clock.now() + HOMING_S
        while self._state()[0] != "IDLE":
            self._interlock.permit(ticket, "home")
            if self._clock.now() > give_up:
                raise self._link.error("home", f"not homed after {HOMING_S:g} s")
            self._clock.sleep(POLL_S)
        if not self._state()[1]:
            raise self._link.error("home", "ended without a reference")

    def position_mm(self):
        return self._state()[2]

    def start_move(self, position_mm, speed_mm_s):
        ticket = self._interlock.ticket()
        limits = self.limits()
        limits["position"].require(DEVICE, "position", position_mm)
        limits["speed"].require(DEVICE, "speed", speed_mm_s)
        self._interlock.require_armed("move")
        if not self.homed():
            raise self._link.error("move", "the stage is not homed", "home it first")
        self._target = position_mm
        self._link.ask(
            f"MOVE {position_mm:.5f} {speed_mm_s:.5f}",
            "OK",
            permit=lambda: self._interlock.permit(ticket, "move"),
        )
        return ticket

    def moving(self):
        state, _, position = self._state()
        self._interlock.require_armed("move")
        if state == "MOVE":
            return True
        if self._target is not None and abs(position - self._target) > ARRIVED_mm:
            self._target = None
            raise self._link.error("move", f"stands at {position:g} mm", "look at the stage")
        self._target = None
        return False

    def move_to(self, position_mm, speed_mm_s):
        ticket = self.start_move(position_mm, speed_mm_s)
        while self.moving():
            self._clock.sleep(POLL_S)
        self._interlock.permit(ticket, "move")

    def stop(self):
        with self._interlock.stopping(rearm=True):
            self.stop_and_wait()

    def stop_and_wait(self):
        self._target = None
        self._link.ask("STOP", "OK")
        give_up = self._clock.now() + BRAKING_S
        while self._state(stopping=True)[0] == "MOVE":
            if self._clock.now() > give_up:
                raise self._link.error("stop", f"still moves after {BRAKING_S:g} s")
            self._clock.sleep(POLL_S)

    def keep_alive(self):
        if self._clock.now() - self._asked_s >= KEEP_ALIVE_S:
            self._state()

    def acknowledge_timeout(self):
        return False  # it has no communication time-out

    def make_safe(self):
        self._interlock.make_safe(lambda: self._link.ask("STOP", "OK", charge=False))

    def close(self):
        self._link.close()

    def _state(self, stopping=False):
        found = self._link.ask("ST?", STATE)
        self._asked_s = self._clock.now()
        if found[1] == "FAIL" and not stopping and not self._interlock.is_stopping:
            raise InstrumentError(DEVICE, "ST?", "the stage reports a failure", "look at it")
        return found[1], found[2] == "1", float(found[3])


class Reader:
    """Sends ``ID?`` and ``ST?``, which change nothing."""

    timeout_s = 0.0  # it has no communication time-out

    def __init__(self, settings, clock):
        self._stage = Z50(settings, clock)

    def open(self):
        self.identity = self._stage.identify()

    def read(self):
        state, homed, position = self._stage._state(stopping=True)
        fault = "failure" if state == "FAIL" else ""
        return StageStatus(position, state == "MOVE", "on", homed, fault)

    def close(self):
        self._stage.close()


def connect(settings, clock):
    return prepared(Z50(settings, clock))


def open_reader(settings, clock):
    return opened(Reader(settings, clock))


def make_safe(settings):
    with closing(Z50(settings, WallClock())) as stage:
        stage.stop_and_wait()

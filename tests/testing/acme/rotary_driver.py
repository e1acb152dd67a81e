"""ACME R30, a rotary stage on a serial line."""

from contextlib import closing
from typing import Literal

from pydantic import Field

from drivers.shared.line_link import LineLink
from drivers.shared.stage import StageInterlock, prepared
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.core.settings import Address, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Identity, Limits

ROLES = ("rotary",)
DEVICE = "rotary"
STATE = r"(IDLE|MOVE|FAIL) ([01]) (-?\d+\.\d+)"
POLL_S = 0.02
KEEP_ALIVE_S = 0.05
BRAKING_S = 2.0
HOMING_S = 60.0
ARRIVED_deg = 0.005


class Settings(BaseSettings):
    driver: Literal["acme-rotary"] = "acme-rotary"
    port: Address[str]
    """Serial port."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    low_limit_deg: float = 0.0
    high_limit_deg: float
    max_speed_deg_s: float = Field(default=20.0, gt=0)


class R30:
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
        found = self._link.ask("ID?", r"(\S+) (\S+) (\S+) (\S+)")
        vendor, model, number, firmware = found.groups()
        if (vendor, model) != ("ACME", "R30"):
            raise self._link.error(
                "ID?",
                f"{self._settings.port} is a {vendor} {model}",
                "an ACME R30 is expected; correct [rotary] in the bench file",
            )
        self.identity = Identity(vendor, model, number, firmware)
        self.stop_and_wait()

    def limits(self):
        own, limited_by = self._settings, f"{DEVICE} {self.identity.model}"
        return {
            "angle": Limits(own.low_limit_deg, own.high_limit_deg, "deg", limited_by),
            "speed": Limits(0.001, own.max_speed_deg_s, "deg/s", limited_by),
            "acceleration": Limits(0.1, 2000.0, "deg/s^2", limited_by),
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

    def angle_deg(self):
        return self._state()[2]

    def start_turn(self, angle_deg, speed_deg_s, acceleration_deg_s2):
        ticket = self._interlock.ticket()
        limits = self.limits()
        limits["angle"].require(DEVICE, "angle", angle_deg)
        limits["speed"].require(DEVICE, "speed", speed_deg_s)
        limits["acceleration"].require(DEVICE, "acceleration", acceleration_deg_s2)
        self._interlock.require_armed("move")
        if not self.homed():
            raise self._link.error("move", "the stage is not homed", "home it first")
        self._target = angle_deg
        self._link.ask(
            f"TURN {angle_deg:.5f} {speed_deg_s:.5f} {acceleration_deg_s2:.5f}",
            "OK",
            permit=lambda: self._interlock.permit(ticket, "move"),
        )
        return ticket

    def moving(self):
        state, _, position = self._state()
        self._interlock.require_armed("move")
        if state == "MOVE":
            return True
        if self._target is not None and abs(position - self._target) > ARRIVED_deg:
            self._target = None
            raise self._link.error("move", f"stands at {position:g} deg", "look at the stage")
        self._target = None
        return False

    def turn_to(self, angle_deg, speed_deg_s, acceleration_deg_s2):
        ticket = self.start_turn(angle_deg, speed_deg_s, acceleration_deg_s2)
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


def connect(settings, clock):
    return prepared(R30(settings, clock))


def make_safe(settings):
    with closing(R30(settings, WallClock())) as stage:
        stage.stop_and_wait()

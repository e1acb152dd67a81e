"""The stage drivers in the words that they have in common, for tests that all of them pass.

Positions and speeds are in the stage's own unit: mm and mm/s, or deg and deg/s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar

from drivers.shared.stage import MotionWatch
from drivers.simulated.instruments.zaber_rst import _RejectedError
from drivers.simulated.transports.modbus_tcp import ModbusError

from . import az, festo, zaber
from .clock import BenchClock

ACCELERATION_deg_s2 = 100.0


class StageCase(ABC):
    """One connected stage over its simulated one; `case` says what may go wrong with it."""

    name: ClassVar[str]
    quantities: ClassVar[tuple[str, str]] = ("position", "speed")
    """What errors call where a motion ends and how fast it is."""
    noun: ClassVar[str] = "axis"
    slow: ClassVar[float] = 0.001
    """A speed at which the reported position stands for more than a second between two steps."""
    stage: Any
    clock: BenchClock

    def start(self, position: float, speed: float) -> None:
        """Begin a motion."""
        self.stage.start_move(position, speed)

    def go(self, position: float, speed: float) -> None:
        """Move and wait."""
        self.stage.move_to(position, speed)

    def seen(self) -> float:
        """The position by the driver."""
        return self.stage.position_mm()

    @property
    @abstractmethod
    def position(self) -> float:
        """The true position."""

    @property
    @abstractmethod
    def speed(self) -> float:
        """The true speed."""

    @abstractmethod
    def said(self) -> Sequence[str]:
        """What went over the wire since this was last asked, oldest first."""

    @property
    @abstractmethod
    def refusal(self) -> tuple[object, str, Exception]:
        """Which method of the simulated stage takes a motion, and what it raises to refuse one."""

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Within it the stage answers to the first motion that it refuses it."""
        owner, name, refused = self.refusal
        usual = getattr(owner, name)

        def refuse(*given: Any) -> None:
            setattr(owner, name, usual)
            raise refused

        setattr(owner, name, refuse)
        yield
        assert getattr(owner, name) == usual, "a motion was sent"

    @property
    def watch_owner(self) -> Any:
        """The object that keeps the watch over the motion under way."""
        return self.stage._watch

    def let_pass(self, seconds: float) -> None:
        """Time passes, and the driver says nothing."""
        self.clock.bench.now_us += round(seconds * 1e6)

    def home(self) -> None:
        """Home the stage, kept alive from now on."""
        self.clock.each_slice(self.stage.keep_alive)
        self.stage.home()
        self.said()

    @property
    def link_lock(self) -> AbstractContextManager[object]:
        """The lock under which the driver's link sends."""
        return self.stage._link._lock

    @property
    def watches(self) -> tuple[Any, str]:
        """The object and the name of its method that begins the watch over a motion, after the
        driver's last look at the stage."""
        return self.stage._watch, "begin"

    @contextmanager
    def before_a_motion_is_sent(self, act: Callable[[], object]) -> Iterator[None]:
        """Do `act` once between the driver's last look at the stage and its command."""
        owner, name = self.watches
        usual = getattr(owner, name)

        def watch(*given: Any) -> MotionWatch | None:
            made: MotionWatch | None = usual(*given)
            delattr(owner, name)
            act()
            return made

        setattr(owner, name, watch)
        yield

    def after(self, seconds: float, act: Callable[[], object]) -> None:
        """Do `act` once, out of a wait of the driver, when `seconds` have passed."""
        due_s = self.clock.now() + seconds

        def slept() -> None:
            if self.clock.now() >= due_s:
                self.clock.slept = None
                act()

        self.clock.slept = slept


class FestoCase(StageCase):
    """The CMMT."""

    name = "festo-cmmt"

    def __init__(self, it: festo.Service):
        self._it, self.clock, self.stage = it, it.clock, it.connect()

    @classmethod
    @contextmanager
    def running(cls, fault: dict[str, Any] | None) -> Iterator[FestoCase]:
        faults = {"faults": festo.move_faults(fault)} if fault else {}
        with festo.service(drive=faults) as it:
            yield cls(it)

    @property
    def position(self) -> float:
        return self._it.truth_mm

    @property
    def speed(self) -> float:
        return self._it.speed

    def said(self) -> Sequence[str]:
        return self._it.wire.heard()

    @property
    def refusal(self) -> tuple[object, str, Exception]:
        return self._it.wire, "write", ModbusError(4)


class AzCase(StageCase):
    """One AZ drive."""

    name = "oriental-az"

    def __init__(self, it: az.Service):
        self._it, self.clock, self.stage = it, it.clock, it.connect()

    @classmethod
    @contextmanager
    def running(cls, fault: dict[str, Any] | None) -> Iterator[AzCase]:
        with az.service(*([{"device": "stage_z", **fault}] if fault else [])) as it:
            yield cls(it)

    @property
    def position(self) -> float:
        return self._it.z.position_mm(self._it.bench.now_us)

    @property
    def speed(self) -> float:
        return self._it.speed(self._it.z)

    def said(self) -> Sequence[str]:
        said = list(self._it.line.said)
        self._it.line.said.clear()
        return said

    @property
    def refusal(self) -> tuple[object, str, Exception]:
        return self._it.z, "write", ModbusError(4)

    @property
    def link_lock(self) -> AbstractContextManager[object]:
        return self.stage._line._lock


class ZaberCase(StageCase):
    """The X-RST."""

    name = "zaber-rst"
    quantities = ("angle", "speed")
    noun = "stage"
    slow = 0.0004

    def __init__(self, it: zaber.Service):
        self._it, self.clock, self.stage = it, it.clock, it.connect()

    @classmethod
    @contextmanager
    def running(cls, fault: dict[str, Any] | None) -> Iterator[ZaberCase]:
        with zaber.service(stage=zaber.suffering(**fault) if fault else None) as it:
            yield cls(it)

    def start(self, position: float, speed: float) -> None:
        self.stage.start_turn(position, speed, ACCELERATION_deg_s2)

    def go(self, position: float, speed: float) -> None:
        self.stage.turn_to(position, speed, ACCELERATION_deg_s2)

    def seen(self) -> float:
        return self.stage.angle_deg()

    @property
    def watches(self) -> tuple[Any, str]:
        return self.stage, "_watch"

    @property
    def position(self) -> float:
        return self._it.angle

    @property
    def speed(self) -> float:
        return self._it.speed

    def said(self) -> Sequence[str]:
        return self._it.wire.heard()

    @property
    def refusal(self) -> tuple[object, str, Exception]:
        return self._it.stage, "_move", _RejectedError("BADDATA")

    @property
    def watch_owner(self) -> Any:
        return self.stage


CASES = (FestoCase, AzCase, ZaberCase)

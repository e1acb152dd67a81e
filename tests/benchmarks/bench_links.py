"""Links with faults that can be detected: never a wrong answer, and at once well again.

The real drivers' links against the real simulators over their real transports. In every round the
simulator is given another true value, then it is asked for while one of five faults happens to the
answer; then it is asked, undisturbed, until the answer is right again. Beside them the stock
clients, used as their manuals show.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_links.py``; `RIG_REPEATS=100` for a
look.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from measured import heading, repeats, row, target
from simulated.axis_bench import AxisBench
from simulated.ideal import IdealBench, serving

from drivers.festo_cmmt import driver as festo_cmmt
from drivers.keysight_33500b import driver as keysight_33500b
from drivers.me_gsv8 import driver as me_gsv8
from drivers.me_gsv8.frames import request as gsv_request
from drivers.oriental_az import driver as oriental_az
from drivers.simulated.faults.plan import FaultPlan, ReplyFault, WireFault
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive
from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.instruments.me_gsv8 import Gsv8
from drivers.simulated.instruments.oriental_az import POSITION, AzDrive, SimulatedAzSettings
from drivers.simulated.instruments.zaber_rst import (
    ZABER_DIALECT,
    SimulatedRotarySettings,
    SimulatedRotaryStage,
)
from drivers.simulated.transports.modbus_rtu import RtuLine
from drivers.simulated.transports.modbus_tcp import ModbusTcpServer
from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer
from drivers.simulated.transports.serial_server import PtyServer
from drivers.simulated.transports.serial_tcp import SerialTcpServer
from drivers.zaber_rst import driver as zaber_rst
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(14_400)]

KINDS = ("silence", "garbage", "close", "truncate", "stale")
"""Those that every transport has."""
FAULTS = repeats(2500)
"""On each of the transports."""
STOCK_FAULTS = max(FAULTS // 25, len(KINDS))
TIMEOUT_S = 0.1
DEAD_TIMEOUT_S = 0.5
DEAD_REPEATS = 20
MOST_TRIES = 20
ROUND_TRIPS = 2000
MAILBOX = 500
SERIAL_NUMBER = 0x1F


class OneFault(WireFaults):
    """Disturbs the answer to the next request that begins so, once it is armed."""

    def __init__(self, request: bytes):
        super().__init__(FaultPlan(), "")
        self.coming: str | None = None
        self.dead = False
        self._request = request

    def fault_for(self, request: bytes, reply: bytes | None) -> ReplyFault | None:
        if self.dead:
            return one("silence")
        if self.coming is None or not request.upper().startswith(self._request):
            return None
        kind, self.coming = self.coming, None
        return one(kind)


def one(kind: str) -> ReplyFault:
    """A fault of this kind."""
    return WireFault.model_validate({"device": "it", "kind": kind})


class Side(ABC):
    """A simulator on its transport; a true value that is set here and asked for over the link."""

    name: str
    request: bytes
    """How the question begins."""
    kinds: tuple[str, ...] = KINDS
    """What happens to the answer."""

    def __init__(self) -> None:
        self.faults = OneFault(self.request)
        self.link: Any = None
        """The driver's, once connected."""

    @contextlib.contextmanager
    def served(self) -> Iterator[None]:
        """The simulator answers."""
        with serving(self.server):
            yield

    @property
    @abstractmethod
    def server(self) -> Any:
        """In front of the simulator."""

    @abstractmethod
    def become(self, value: int) -> None:
        """The simulator's value is this from now on."""

    def ours(self, timeout_s: float) -> Callable[[], int]:
        """The question over the driver's link, connected anew."""
        if self.link is not None:
            self.link.close()
        self.link = self.connect(timeout_s)
        return self.ask

    @abstractmethod
    def connect(self, timeout_s: float) -> Any:
        """The link of a driver that has just connected."""

    @abstractmethod
    def ask(self) -> int:
        """The question."""

    @abstractmethod
    def stock(self) -> Callable[[], int]:
        """The question by the stock client, connected."""


class Generator(Side):
    """The frequency of a 33500B over VISA."""

    request = b"SOUR1:FREQ?"

    def __init__(self, link: str):
        super().__init__()
        self.name = f"VISA {link}"
        self._link = link
        bench = IdealBench()
        self._core = Keysight33500B(bench, bench)
        kind = HislipServer if link == "HiSLIP" else ScpiSocketServer
        self._server = kind(self._core, faults=self.faults)

    @property
    def server(self) -> Any:
        return self._server

    @property
    def resource(self) -> str:
        port = self._server.port
        where = f"hislip0,{port}::INSTR" if self._link == "HiSLIP" else f"{port}::SOCKET"
        return f"TCPIP::127.0.0.1::{where}"

    def become(self, value: int) -> None:
        self._core.process(f"SOUR1:FREQ {value}".encode(), "bench")

    def connect(self, timeout_s: float) -> Any:
        own = keysight_33500b.Settings(
            resource=self.resource, timeout_s=timeout_s, max_amplitude_V=5.0
        )
        return keysight_33500b.connect(own, WallClock())._link

    def ask(self) -> int:
        question = self.request.decode()
        return round(self.link.number(question, self.link.query(question)))

    def stock(self) -> Callable[[], int]:
        import pyvisa

        session: Any = pyvisa.ResourceManager("@py").open_resource(self.resource)
        session.timeout = round(1e3 * TIMEOUT_S)
        session.write_termination = session.read_termination = "\n"
        return lambda: round(float(session.query(self.request.decode())))


class Drive(Side):
    """A register of a CMMT over Modbus TCP."""

    name = "Modbus TCP"
    request = b"FC3 500"

    def __init__(self) -> None:
        super().__init__()
        self._drive = CmmtDrive(SimulatedCmmtSettings(), AxisBench())
        self._server = ModbusTcpServer(self._drive, faults=self.faults)

    @property
    def server(self) -> Any:
        return self._server

    def become(self, value: int) -> None:
        self._drive.write(MAILBOX, [value], "bench")

    def connect(self, timeout_s: float) -> Any:
        own = festo_cmmt.Settings(
            axis="z", host="127.0.0.1", port=self._server.port, timeout_s=timeout_s,
            low_limit_mm=0, high_limit_mm=80, max_speed_mm_s=20,
        )  # fmt: skip
        return festo_cmmt.connect(own, WallClock())._link

    def ask(self) -> int:
        return int(self.link.read(MAILBOX, 1)[0])

    def stock(self) -> Callable[[], int]:
        from pymodbus.client import ModbusTcpClient

        client = ModbusTcpClient("127.0.0.1", port=self._server.port, timeout=TIMEOUT_S)
        client.connect()

        def ask() -> int:
            reply = client.read_holding_registers(MAILBOX, count=1, device_id=1)
            if reply.isError():
                raise OSError(reply)
            return int(reply.registers[0])

        return ask


class Amplifier(Side):
    """The serial number of a GSV-8 over a serial line."""

    name = "GSV serial"
    request = b"1F"

    def __init__(self) -> None:
        super().__init__()
        bench = IdealBench()
        bench.noise_key = ()  # type: ignore[attr-defined]
        bench.force_N = lambda times_s: None  # type: ignore[attr-defined]
        self._core = Gsv8(bench, bench)  # type: ignore[arg-type]
        self._server = PtyServer(self._core, bench, slaved=True, faults=self.faults)

    @property
    def server(self) -> Any:
        return self._server

    def become(self, value: int) -> None:
        self._core.amplifier.identity.serial_number = f"{value:08d}"

    def connect(self, timeout_s: float) -> Any:
        own = me_gsv8.Settings(port=self._server.path, timeout_s=timeout_s)
        return me_gsv8.connect(own, WallClock())._link

    def ask(self) -> int:
        return int(self.link.request(me_gsv8.GET_SERIAL_NUMBER))

    def stock(self) -> Callable[[], int]:
        import serial

        port = serial.Serial(self._server.path, 230_400, timeout=TIMEOUT_S)

        def ask() -> int:
            port.write(gsv_request(SERIAL_NUMBER))
            return int(port.read(12)[3:11])

        return ask


class Stage(Side):
    """A limit of the rotary stage over a serial line or TCP."""

    request = b"GET LIMIT.MAX"
    kinds = (*KINDS, "checksum", "double")

    def __init__(self, link: str):
        super().__init__()
        self.name = f"Zaber {link}"
        self.faults.dialect = ZABER_DIALECT
        bench = IdealBench()
        self._stage = SimulatedRotaryStage(SimulatedRotarySettings(), bench)
        self._server: PtyServer | SerialTcpServer = (
            PtyServer(self._stage.line(), bench, slaved=True, faults=self.faults)
            if link == "serial"
            else SerialTcpServer(self._stage.line, faults=self.faults)
        )

    @property
    def server(self) -> Any:
        return self._server

    @property
    def port(self) -> str:
        if isinstance(self._server, PtyServer):
            return self._server.path
        return f"socket://127.0.0.1:{self._server.port}"

    def become(self, value: int) -> None:
        self._stage.values["limit.max"] = value

    def connect(self, timeout_s: float) -> Any:
        own = zaber_rst.Settings(
            port=self.port, timeout_s=timeout_s, microstep_deg=0.00015625, low_limit_deg=0,
            high_limit_deg=90, max_speed_deg_s=20, max_acceleration_deg_s2=200,
        )  # fmt: skip
        return zaber_rst.connect(own, WallClock())._link

    def ask(self) -> int:
        return int(self.link.ask(1, "get limit.max").data)

    def stock(self) -> Callable[[], int]:
        import serial

        if self.link is not None:
            self.link.close()
        port: Any = serial.serial_for_url(self.port, 115_200, timeout=TIMEOUT_S)

        def ask() -> int:
            port.write(b"/1 1 get limit.max\n")
            return int(port.readline().split()[5])

        return ask


class LineDrive(Side):
    """A register of an AZ drive over Modbus RTU."""

    name = "Modbus RTU"
    request = b"FC3 92"

    def __init__(self) -> None:
        super().__init__()
        bench = AxisBench()
        self._drive = AzDrive(SimulatedAzSettings("it"), bench)
        self._server = PtyServer(
            RtuLine([self._drive], bench), bench, slaved=True, faults={"it": self.faults}
        )

    @property
    def server(self) -> Any:
        return self._server

    def become(self, value: int) -> None:
        self._drive.write(POSITION, [0, value], "bench")

    def connect(self, timeout_s: float) -> Any:
        own = oriental_az.Settings(
            axis="z", port=self._server.path, parity="N", unit_id=1, timeout_s=timeout_s,
            steps_per_mm=1000, low_limit_mm=0, high_limit_mm=80, max_speed_mm_s=20,
        )  # fmt: skip
        return oriental_az.connect(own, WallClock())._link

    def ask(self) -> int:
        return int(self.link.read_value(POSITION))

    def stock(self) -> Callable[[], int]:
        from pymodbus.client import ModbusSerialClient

        client = ModbusSerialClient(
            self._server.path, baudrate=230_400, timeout=TIMEOUT_S, retries=0
        )
        client.connect()

        def ask() -> int:
            reply = client.read_holding_registers(POSITION, count=2, device_id=1)
            if reply.isError():
                raise OSError(reply)
            return int(reply.registers[1])

        return ask


SIDES: dict[str, Callable[[], Side]] = {
    "socket": lambda: Generator("socket"),
    "hislip": lambda: Generator("HiSLIP"),
    "modbus": Drive,
    "serial": Amplifier,
    "zaber-serial": lambda: Stage("serial"),
    "zaber-tcp": lambda: Stage("TCP"),
    "rtu": LineDrive,
}


class Count:
    """What became of questions that a fault befell, and of those after it."""

    def __init__(self) -> None:
        self.outcomes = Counter[str]()
        self.wrong: list[str] = []
        self.further = Counter[int]()
        """How many questions after the disturbed one failed as well."""
        self.undisturbed: list[str] = []
        """What those said."""

    def tell(self, name: str) -> None:
        """Print it in a few lines."""
        shown = ", ".join(f"{count} {what}" for what, count in sorted(self.outcomes.items()))
        print(f"{name}: {shown}; {len(self.wrong)} wrong answers")
        after = ", ".join(f"{count} x {n}" for n, count in sorted(self.further.items()))
        print(f"    failed questions after a disturbed one: {after}")
        for words in (*self.wrong[:3], *self.undisturbed[:3]):
            print(f"    {words}")


def ask_often(
    side: Side, ask: Callable[[], int], rounds: int, failures: tuple[type[Exception], ...]
) -> Count:
    """Ask with a fault, then without one until the answer is right; each time for another value."""
    count = Count()
    values = itertools.cycle(range(1001, 60_000))

    def once(kind: str | None) -> bool:
        value = next(values)
        side.become(value)
        side.faults.coming = kind
        try:
            got = ask()
        except failures as error:
            what = type(error).__name__
            if kind is None:
                count.undisturbed.append(f"undisturbed: {error}")
        else:
            what = "right" if got == value else "WRONG"
            if got != value:
                count.wrong.append(f"{got} instead of {value} ({kind or 'undisturbed'})")
        if kind is not None:
            count.outcomes[f"{what} ({kind})"] += 1
        return what == "right"

    for number in range(rounds):
        once(side.kinds[number % len(side.kinds)])
        side.faults.coming = None
        further = 0
        while further < MOST_TRIES and not once(None):
            further += 1
        count.further[further] += 1
    return count


@pytest.mark.parametrize("which", SIDES)
def test_no_wrong_answer_and_at_most_one_further_failure(which: str) -> None:
    side = SIDES[which]()
    heading(f"{side.name}: {FAULTS} questions with a fault, time-out {TIMEOUT_S:g} s")
    with side.served():
        begun = time.perf_counter()
        count = ask_often(side, side.ours(TIMEOUT_S), FAULTS, (InstrumentError,))
        count.tell("driver's link")
        print(f"    {time.perf_counter() - begun:.0f} s")
    assert count.wrong == []
    assert max(count.further) <= 1


@pytest.mark.parametrize("which", SIDES)
def test_the_stock_client_beside_it(which: str) -> None:
    """It is connected anew where the operating system or its library says that the link broke."""
    side = SIDES[which]()
    heading(f"{side.name}: the stock client, {STOCK_FAULTS} questions with a fault")
    with side.served():
        client = side.stock()

        def ask() -> int:
            nonlocal client
            try:
                return client()
            except (OSError, RuntimeError):
                client = side.stock()
                raise

        ask_often(side, ask, STOCK_FAULTS, (Exception,)).tell("stock client")


@pytest.mark.parametrize("which", SIDES)
def test_a_question_takes_this_long(which: str) -> None:
    side = SIDES[which]()
    heading(f"{side.name}: {ROUND_TRIPS} questions in a row")
    took_ms = []
    with side.served():
        ask = side.ours(DEAD_TIMEOUT_S)
        for value in range(1001, 1001 + ROUND_TRIPS):
            side.become(value)
            begun = time.perf_counter()
            assert ask() == value
            took_ms.append(1e3 * (time.perf_counter() - begun))
    row("round trip", took_ms, "ms")


@pytest.mark.parametrize("which", SIDES)
def test_a_dead_device_is_reported_in_time(which: str) -> None:
    side = SIDES[which]()
    heading(f"{side.name}: silent for ever, time-out {DEAD_TIMEOUT_S:g} s")
    first, again = [], []
    side.become(1001)
    with side.served():
        for _ in range(DEAD_REPEATS):
            side.faults.dead = False
            ask = side.ours(DEAD_TIMEOUT_S)
            ask()
            side.faults.dead = True
            for found in (first, again):
                begun = time.perf_counter()
                with pytest.raises(InstrumentError):
                    ask()
                found.append((time.perf_counter() - begun) / DEAD_TIMEOUT_S)
    row("until the first failure", first, "time-outs")
    row("until the next one, link opened anew", again, "time-outs")
    target("a dead device is reported", max(first + again), 1.2, "time-outs")

"""A bit that is turned over on its way: what the client library raises is an error of the link."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import pytest
from flipping_proxy import flipping
from simulated.ideal import serving
from tiers import mostly_thorough

from drivers.festo_cmmt.link import CmmtLink
from drivers.me_gsv8 import driver as me_gsv8
from drivers.oriental_az.link import AzLine, AzLink
from drivers.shared.line_link import LineLink
from drivers.shared.visa_link import VisaLink
from drivers.simulated.transports.modbus_tcp import ModbusTcpServer
from drivers.simulated.transports.scpi_servers import HislipServer
from drivers.zaber_rst.link import ZaberLink
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError

HEADER_BYTES = 16
TIMEOUT_S = 1.0
DEVICES = ("daq", "stage_z", "rotary", "force_sensor")


def bits_of_a_byte(by_default: int) -> list[Any]:
    """Return all bits of a byte in two parameter sets: the one of the default tier, and the
    others."""
    others = [bit for bit in range(8) if bit != by_default]
    return [
        pytest.param([by_default], id=f"bit {by_default}"),
        pytest.param(others, id="other bits", marks=pytest.mark.thorough),
    ]


def at_once(flip: Callable[[int, int], None], byte: int, bits: list[int]) -> None:
    """Flip each bit on a link of its own, all at the same time: most of it is waiting."""
    with ThreadPoolExecutor(len(bits)) as threads:
        list(threads.map(partial(flip, byte), bits))


class Scpi:
    """Answers every message alike."""

    def process(self, message: bytes, by: str) -> bytes:
        return b"answer\n"

    def trigger(self, by: str) -> None:
        raise AssertionError("a trigger came")

    def status_byte(self, message_available: bool = False) -> int:
        return 0


def flip_in_hislip(byte: int, bit: int) -> None:
    scpi: Any = Scpi()
    server = HislipServer(scpi)
    with serving(server), flipping(server.port) as proxy:
        resource = f"TCPIP::127.0.0.1::hislip0,{proxy.port}::INSTR"
        link = VisaLink("daq", resource, TIMEOUT_S, WallClock())
        assert link.query("*IDN?") == "answer"
        proxy.flip(byte, bit)
        # Bytes that a client need not read, such as the control code, may pass.
        with contextlib.suppress(InstrumentError):
            assert link.query("READ?") == "answer", f"bit {bit}"
        assert link.query("*IDN?") == "answer", f"no new connection opened after bit {bit}"
        link.close()


@pytest.mark.parametrize("bits", bits_of_a_byte(by_default=0))
@pytest.mark.parametrize("byte", mostly_thorough(range(HEADER_BYTES), [0, 2, 3, 8]))
def test_a_flipped_bit_in_a_hislip_header_is_an_error_of_the_link(
    byte: int, bits: list[int]
) -> None:
    at_once(flip_in_hislip, byte, bits)


class Registers:
    """A drive in which every register is 7."""

    def read(self, address: int, count: int, by: str) -> list[int]:
        return [7] * count

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        raise AssertionError("nothing is written")

    def identification(self) -> Mapping[int, str]:
        raise AssertionError("nobody asks")


def flip_in_modbus(byte: int, bit: int) -> None:
    server = ModbusTcpServer(Registers())
    with serving(server), flipping(server.port) as proxy:
        link = CmmtLink("stage_z", "127.0.0.1", proxy.port, 1, TIMEOUT_S, WallClock())
        assert link.read(100, 1) == [7]
        proxy.flip(byte, bit)
        with contextlib.suppress(InstrumentError):
            assert link.read(100, 1) == [7], f"bit {bit}"
        assert link.read(100, 1) == [7], f"no new connection opened after bit {bit}"
        link.close()


@pytest.mark.parametrize("bits", bits_of_a_byte(by_default=1))
@pytest.mark.parametrize("byte", mostly_thorough(range(9), [0, 3, 5, 7, 8]))
def test_a_flipped_bit_in_a_modbus_header_is_an_error_of_the_link(
    byte: int, bits: list[int]
) -> None:
    at_once(flip_in_modbus, byte, bits)


def raising(*_: object, **__: object) -> Any:
    raise KeyError("of the library")


def the_links() -> dict[str, tuple[str, Any]]:
    clock = WallClock()
    az_line = AzLine("/dev/none", 9600, "E", clock)
    return {
        "visa": ("pyvisa.ResourceManager", lambda: VisaLink("daq", "x", 1, clock).query("*IDN?")),
        "cmmt": (
            "drivers.festo_cmmt.link.ModbusTcpClient.connect",
            lambda: CmmtLink("stage_z", "127.0.0.1", 9, 1, 1, clock).read(100, 1),
        ),
        "az": (
            "serial.Serial",
            lambda: AzLink("stage_z", az_line, 1, 1, clock).read(0, 1),
        ),
        "zaber": (
            "serial.Serial",
            lambda: ZaberLink("rotary", "/dev/none", 9600, 1, 1, clock).ask(0, ""),
        ),
        "gsv": (
            "serial.Serial",
            lambda: me_gsv8.connect(me_gsv8.MeGsv8Settings(port="/dev/none"), clock),
        ),
        "line": ("serial.Serial", lambda: LineLink("daq", "/dev/none", 1, clock).ask("*IDN?")),
    }


@pytest.mark.parametrize("link", sorted(the_links()))
def test_whatever_a_library_raises_names_the_device_and_the_remedy(
    link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, ask = the_links()[link]
    monkeypatch.setattr(place, raising)
    with pytest.raises(InstrumentError) as caught:
        ask()
    assert caught.value.message.split(":")[0] in DEVICES
    assert "of the library" in caught.value.message
    assert caught.value.hint

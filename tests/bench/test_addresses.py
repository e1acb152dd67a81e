"""The addresses of an instrument, under which its locks, marks and latches are kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import packages
import pytest

from rig.bench.addresses import addresses_of
from rig.bench.plan import parse_bench, parse_to_make_safe
from rig.core.errors import ConfigurationError
from rig.core.settings import Address, Settings, wiring_of
from rig.run.locks.lock import address_names

STAGE = "low_limit_mm = 0\nhigh_limit_mm = 20\nmax_speed_mm_s = 20\n"
BUILT_IN = {
    "keysight-33500b": (
        "generator",
        'resource = "TCPIP::127.0.0.1::5025::SOCKET"\nmax_amplitude_V = 5.0\n',
        ("TCPIP::127.0.0.1::5025::SOCKET", "TCPIP0::127.0.0.1::5025::SOCKET"),
    ),
    "keysight-u2300a": (
        "daq",
        'resource = "USB0::0x0957::0x1518::TW1::INSTR"\nchannels = { film = 102 }\n',
        ("USB0::0X0957::0X1518::TW1::INSTR", "USB0::2391::5400::TW1::INSTR"),
    ),
    "festo-cmmt": (
        "stage_z",
        f'axis = "z"\nhost = "127.0.0.1"\nunit_id = 3\n{STAGE}',
        ("127.0.0.1 502 3",),
    ),
    "oriental-az": (
        "stage_z",
        f'axis = "z"\nport = "/dev/ttyNone"\nunit_id = 3\nsteps_per_mm = 1000\n{STAGE}',
        ("/DEV/TTYNONE",),
    ),
    "zaber-rst": (
        "rotary",
        'port = "socket://127.0.0.2:55550"\ndevice = 2\nmicrostep_deg = 0.0002\n'
        "low_limit_deg = 0\nhigh_limit_deg = 30\nmax_speed_deg_s = 20\n"
        "max_acceleration_deg_s2 = 100\n",
        ("SOCKET://127.0.0.2:55550", "SOCKET://127.0.0.1:55550"),
    ),
    "me-gsv8": ("force_sensor", 'port = "/dev/ttyNone"\n', ("/DEV/TTYNONE",)),
}
"""Role, settings and addresses, by driver."""
BENCH = 'name = "b"\n[fixture]\nmounted = "plate"\n[{role}]\ndriver = "{driver}"\n{settings}'


@pytest.mark.parametrize("driver", BUILT_IN)
def test_the_addresses_of_the_drivers_stay_as_they_are(driver: str) -> None:
    """What an earlier version has written under them, such as the latch of a contact that opened,
    has to be found."""
    role, settings, expected = BUILT_IN[driver]
    text = BENCH.format(role=role, driver=driver, settings=settings)
    (part,) = parse_bench(text, "bench.toml").instruments
    assert addresses_of(part.settings) == expected


class Elsewhere(Settings):
    """Settings of a driver of another package."""

    driver: str = "elsewhere"
    ip: Address[str]
    tcp_port: Address[int] = 4001
    bus_number: Address[int | None] = None
    port: str = "A"
    """The connector that is wired; it does not form the address."""


def test_an_address_is_what_its_driver_marks() -> None:
    """Two instruments that differ in a marked setting alone are two; in any other, one."""
    assert addresses_of(Elsewhere(ip="127.0.0.1")) == ("127.0.0.1 4001",)
    assert addresses_of(Elsewhere(ip="127.0.0.1", port="B")) == ("127.0.0.1 4001",)
    assert addresses_of(Elsewhere(ip="127.0.0.1", tcp_port=4002)) == ("127.0.0.1 4002",)
    assert addresses_of(Elsewhere(ip="127.0.0.1", bus_number=7)) == ("127.0.0.1 4001 7",)
    assert addresses_of(Elsewhere(ip="localhost")) == ("LOCALHOST 4001", "127.0.0.1 4001")
    assert addresses_of(Elsewhere(ip="::1")) == ("::1 4001", "127.0.0.1 4001")
    assert wiring_of(Elsewhere) == {"ip", "tcp_port", "bus_number"}


class OneText(Settings):
    device: Address[str]


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        ("socket://localhost:4001", ("SOCKET://LOCALHOST:4001", "SOCKET://127.0.0.1:4001")),
        (
            "TCPIP::localhost::7::SOCKET",
            ("TCPIP::LOCALHOST::7::SOCKET", "TCPIP0::127.0.0.1::7::SOCKET"),
        ),
        ("ASRL/dev/ttyNone::INSTR", ("ASRL/DEV/TTYNONE::INSTR", "/DEV/TTYNONE")),
        ("/dev/../dev/ttyNone", ("/DEV/../DEV/TTYNONE", "/DEV/TTYNONE")),
        ("MY12345678", ("MY12345678",)),
    ],
)
def test_the_form_of_an_address_says_which_other_names_it_has(
    device: str, expected: tuple[str, ...]
) -> None:
    assert addresses_of(OneText(device=device)) == expected


DRIVER = """from rig.core.settings import Address, Settings as BaseSettings
ROLES = ("force_sensor",)
class Settings(BaseSettings):
    driver: str
    {settings}
def connect(settings, clock): ...
def make_safe(settings): ...
"""
MODULES = {
    "lab_unmarked": "timeout_s: float = 0.5; host: str; port: int = 502",
    "lab_nowhere": "timeout_s: float = 0.5; tcp_port: int = 4001",
    "lab_left_out": "timeout_s: float = 0.5; host: Address[str | None] = None",
    "lab_hasty": "host: Address[str]",
}
"""Settings of drivers of another package, by their module's name."""


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package lab-sensors with these drivers is installed."""
    sources = {name: DRIVER.format(settings=own) for name, own in MODULES.items()}
    yield from packages.drivers_installed(tmp_path, monkeypatch, "lab-sensors", sources)


def lab_bench(driver: str, settings: str = "") -> str:
    return BENCH.format(role="force_sensor", driver=driver, settings=settings)


@pytest.mark.usefixtures("lab")
@pytest.mark.parametrize("given", ["", "timeout_s = 0.5\n"])
def test_a_driver_without_a_timeout_is_refused_for_runs_by_its_package(given: str) -> None:
    text = lab_bench("lab_hasty", f'host = "127.0.0.1"\n{given}')
    with pytest.raises(ConfigurationError, match="has Settings that lack timeout_s") as refused:
        parse_bench(text, "bench.toml")
    assert "driver 'lab_hasty' of the package lab-sensors" in refused.value.message
    assert refused.value.hint == "fix the package lab-sensors or uninstall it"
    if not given:
        assert not parse_to_make_safe(text, "bench.toml").failures


@pytest.mark.usefixtures("lab")
def test_a_driver_of_before_the_mark_keeps_its_address() -> None:
    text = lab_bench("lab_unmarked", 'host = "127.0.0.1"\n')
    (part,) = parse_bench(text, "bench.toml").instruments
    assert addresses_of(part.settings) == ("127.0.0.1 502",)


@pytest.mark.usefixtures("lab")
@pytest.mark.parametrize("driver", ["lab_nowhere", "lab_left_out"])
def test_an_instrument_without_an_address_is_refused_for_runs_and_made_safe(driver: str) -> None:
    """Benches of which nothing tells them apart would be in use, marked and latched together."""
    with pytest.raises(ConfigurationError) as refused:
        parse_bench(lab_bench(driver), "bench.toml")
    line = refused.value.one_line()
    assert f"[force_sensor]: no setting of the driver '{driver}' of the package lab-sensors" in line
    assert "as in port: Address[str]" in line
    restable = parse_to_make_safe(lab_bench(driver), "bench.toml")
    assert [part.role for part in restable.instruments] == ["force_sensor"]
    assert not restable.failures
    assert not address_names(restable)

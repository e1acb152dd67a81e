"""Settings of a driver of another package that the bench understands: marked, or by usual names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import packages
import pytest

from rig.bench.braking import USUAL_DECELERATION_mm_s2, braking_bound
from rig.bench.driver_settings import channels_of, communication_timeout, deceleration_mm_s2
from rig.bench.plan import BenchPlan, parse_bench, parse_to_make_safe
from rig.core.errors import ConfigurationError
from rig.core.settings import wiring_of

DRIVER = """from rig.core.settings import (
    Address, Channels, CommunicationTimeout, Deceleration, Settings as BaseSettings
)
ROLES = ("daq", "stage_z")
class Settings(BaseSettings):
    driver: str
    host: Address[str] = "127.0.0.1"
    timeout_s: float = 0.4
    {settings}
def connect(settings, clock): ...
def make_safe(settings): ...
"""
MODULES = {
    "lab_daq": "inputs: Channels[dict[str, int]]",
    "lab_unmarked_daq": "channels: dict[str, int]",
    "lab_daq_without": "wires: dict[str, int]",
    "lab_stage": "watchdog_s: CommunicationTimeout[float] = 1.5; a_mm_s2: Deceleration[int] = 80",
    "lab_unmarked_stage": "communication_timeout_ms: int = 1500; deceleration_mm_s2: float = 80.0",
    "lab_stage_without": "watchdog_s: float = 1.5; ramp_mm_s2: float = 80.0",
    "lab_wrong_unit": "watchdog_us: CommunicationTimeout[int] = 1500",
    "lab_twice": "up_mm_s2: Deceleration[int] = 80; down_mm_s2: Deceleration[int] = 90",
}
"""Settings of drivers of another package, by their module's name."""
HEAD = 'name = "lab"\n[fixture]\nmounted = "film-clamp"\n'


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package lab-instruments with these drivers is installed."""
    sources = {name: DRIVER.format(settings=own) for name, own in MODULES.items()}
    yield from packages.drivers_installed(tmp_path, monkeypatch, "lab-instruments", sources)


def stage(driver: str, settings: str = "") -> str:
    return f'{HEAD}[stage_z]\ndriver = "{driver}"\n{settings}'


def daq(driver: str, settings: str) -> str:
    return f'{HEAD}[film]\n[daq]\ndriver = "{driver}"\n{settings}\n'


def deceleration_used(plan: BenchPlan) -> float:
    """The deceleration that bounds the speed of z."""
    fixture = SimpleNamespace(stiffest_N_mm=10.0)
    stage_z = SimpleNamespace(limits=lambda: {"update_rate": SimpleNamespace(high=100.0)})
    bench: Any = SimpleNamespace(
        plan=plan, stage_z=stage_z, settings=SimpleNamespace(fixture=fixture)
    )
    return braking_bound(bench, 1.0).deceleration_mm_s2


@pytest.mark.parametrize(
    ("driver", "key"), [("lab_daq", "inputs"), ("lab_unmarked_daq", "channels")]
)
def test_the_bench_knows_what_is_wired_by_mark_and_by_the_usual_name(driver: str, key: str) -> None:
    (part,) = parse_bench(daq(driver, f"{key} = {{ film = 7 }}"), "bench.toml").instruments
    assert channels_of(part.settings) == {"film": 7}
    with pytest.raises(ConfigurationError, match=rf"\[daq.{key}\] wires no film"):
        parse_bench(daq(driver, f"{key} = {{ load_cell = 7 }}"), "bench.toml")


def test_a_daq_whose_driver_declares_no_channels_is_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigurationError) as refused:
        parse_bench(daq("lab_daq_without", "wires = { film = 7 }"), "bench.toml")
    assert "[film] is described, but the driver of [daq] has no setting of its channels" in str(
        refused.value
    )
    assert "as in channels: Channels[dict[str, int]]" in str(refused.value)


@pytest.mark.parametrize(
    ("driver", "key", "value", "most"),
    [
        ("lab_stage", "watchdog_s", "0.4", "0.4 s"),
        ("lab_unmarked_stage", "communication_timeout_ms", "400", "400 ms"),
    ],
)
def test_a_drive_that_stops_by_itself_and_how_it_brakes_are_known(
    driver: str, key: str, value: str, most: str
) -> None:
    plan = parse_bench(stage(driver), "bench.toml")
    (part,) = plan.instruments
    stated = communication_timeout(part.settings)
    assert stated is not None
    assert (stated.name, stated.seconds) == (key, 1.5)
    assert deceleration_mm_s2(part.settings) == deceleration_used(plan) == 80.0
    with pytest.raises(ConfigurationError) as refused:
        parse_bench(stage(driver, f"{key} = {value}\n"), "bench.toml")
    assert f"no time for a second request within {key} = {most}" in refused.value.one_line()


def test_a_marked_communication_timeout_is_wiring() -> None:
    (part,) = parse_bench(stage("lab_stage"), "bench.toml").instruments
    assert wiring_of(type(part.settings)) == {"host", "watchdog_s"}


def test_without_mark_and_usual_name_the_bench_assumes_what_the_page_says() -> None:
    plan = parse_bench(stage("lab_stage_without"), "bench.toml")
    assert communication_timeout(plan.instruments[0].settings) is None
    assert deceleration_used(plan) == USUAL_DECELERATION_mm_s2 == 200.0


@pytest.mark.parametrize(
    ("driver", "words"),
    [
        ("lab_wrong_unit", "watchdog_us is marked as CommunicationTimeout: its name must end"),
        ("lab_twice", "up_mm_s2 and down_mm_s2 are both marked as Deceleration"),
    ],
)
def test_marks_that_cannot_be_read_are_refused_for_runs_and_made_safe(
    driver: str, words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        parse_bench(stage(driver), "bench.toml")
    assert [p.role for p in parse_to_make_safe(stage(driver), "bench.toml").instruments] == [
        "stage_z"
    ]

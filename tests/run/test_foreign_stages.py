"""Stages of another package: what they return wrongly names them, and keeps no z from being lifted.

Dry runs of a slip trial whose stages both belong to a package; their driver is made wrong.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import packages
import pytest

ACME = Path(__file__).parents[1] / "testing" / "acme"
ENTRIES = """[rig.drivers]
acme-z = acme.z_driver
acme-x = acme.x_driver
[rig.simulators]
acme-z = acme.z_simulator:Z50Core
acme-x = acme.x_simulator:Z50Core
"""
STAGE = """[stage_{axis}]
driver = "acme-{axis}"
port = "socket://10.0.0.4:400{line}"
high_limit_mm = {high_mm}
max_speed_mm_s = 20.0
torque_limit_percent = 25.0
"""
BENCH = f"""name = "real"
[fixture]
mounted = "plate"
contact_from_mm = 12.0
contact_to_mm = 13.0
stiffest_contact_N_mm = 150.0
[skin]
[daq]
driver = "keysight-u2300a"
resource = "TCPIP::127.0.0.1::hislip0,1::INSTR"
channels = {{ strip_1 = 101, strip_2 = 102 }}
{STAGE.format(axis="z", line=1, high_mm=20.0)}
{STAGE.format(axis="x", line=2, high_mm=40.0)}
{packages.FORCE_SENSOR}"""
POSITION = "return self._state()[2]"
PRESSED_mm = 11.0
"""Positions of z above which it presses nothing."""


def change(rig: Any, axis: str, right: str, wrong: str) -> None:
    """Make the driver of an axis wrong."""
    driver = rig.folder / "site" / "acme" / f"{axis}_driver.py"
    text = driver.read_text()
    assert text.count(right) == 1
    driver.write_text(text.replace(right, wrong))


def dry_run(rig: Any, *options: str) -> Any:
    given = ("-n", "1", "--rehearsal", "never", "--dry-run", "--world-log", str(rig.world_log))
    return rig.run("slip-trial", *given, *options)


@pytest.fixture
def acme(rig: Any) -> Any:
    """The command line with both stages of the package, and a bench file that names them."""
    modules = {"acme/__init__.py": ""}
    for axis in "zx":
        for part in ("driver", "simulator"):
            text = (ACME / f"stage_{part}.py").read_text()
            text = text.replace("stage_z", f"stage_{axis}").replace("acme-stage", f"acme-{axis}")
            modules[f"acme/{axis}_{part}.py"] = text
    site = packages.install(rig.folder / "site", "acme", ENTRIES, modules)
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(BENCH)
    return rig


def z_is_lifted(rig: Any) -> bool:
    """Return whether z has come to rest above what it presses, as the World has it."""
    z = [e for e in rig.log() if e["device"] == "stage_z" and e["what"] in ("move", "at-rest")]
    return z[-1]["what"] == "at-rest" and bool(z[-1]["value"] < PRESSED_mm)


WRONG = {
    "nan": ("float('nan')", "returned nan"),
    "far away": ("4200.0", "returned 4200 mm, outside its limits of 0 to {limit} mm"),
    "text": ("str(self._state()[2])", "returned '"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("axis", "xz")
def test_a_wrong_position_at_the_start_of_a_run_is_named_and_nothing_is_pressed(
    acme: Any, axis: str, kind: str
) -> None:
    value, words = WRONG[kind]
    change(acme, axis, POSITION, f"return {value}")
    done = dry_run(acme)
    assert done.code == 3, done.stderr
    limit = {"x": 40, "z": 20}[axis]
    assert f"error: stage_{axis}: position_mm: {words.format(limit=limit)}" in done.stderr
    assert f"the driver 'acme-{axis}' of the package acme" in done.stderr
    assert "journal" not in done.stderr
    assert "NOT SAFE" not in done.stderr
    assert z_is_lifted(acme)


@pytest.mark.thorough
@pytest.mark.parametrize("value", ["float('nan')", "str(self._state()[2])", "-4200.0", "4200.0"])
def test_a_position_of_z_that_becomes_wrong_while_it_presses_does_not_keep_it_pressed(
    acme: Any, value: str
) -> None:
    wrong = f"here = self._state()[2]\n        return {value} if self.pressed(here) else here"
    change(acme, "z", POSITION, wrong)
    pressed = "    deep = False\n\n    def pressed(self, here):\n"
    pressed += "        self.deep = self.deep or here > 12.4\n        return self.deep\n\n"
    change(acme, "z", "    def prepare(self):", f"{pressed}    def prepare(self):")
    done = dry_run(acme)
    assert "touch-down" in [e["what"] for e in acme.log()]
    assert done.code == 3, done.stderr
    assert "error: stage_z: position_mm: returned " in done.stderr
    assert z_is_lifted(acme) is (value != "-4200.0")  # what the drive goes by leads down


@pytest.mark.thorough
def test_a_dry_run_shows_what_was_not_switched_off(acme: Any) -> None:
    stop = "with self._interlock.stopping(rearm=True):"
    change(acme, "z", stop, f'raise TypeError("oops")\n        {stop}')
    done = dry_run(acme)
    assert done.code == 7, done.stderr
    assert re.search(r"could not be switched off: \S+ line \d+: TypeError: oops", done.stderr)


@pytest.mark.thorough
def test_a_dry_run_shows_the_traceback_of_a_driver_that_cannot_connect(acme: Any) -> None:
    change(acme, "x", 'self._link.ask(f"TORQUE {limit}", "OK")', "1 / 0")
    done = dry_run(acme, "--json")
    assert done.code == 2, done.stderr
    assert "driver 'acme-x' of the package acme" in done.stderr
    assert "x_driver.py line" in done.stderr
    assert "ZeroDivisionError: division by zero" in done.stderr
    assert "Traceback (most recent call last)" in done.stderr
    assert done.object["exit"] == 2


@pytest.mark.thorough
def test_a_fault_of_a_driver_in_the_checks_names_its_package(acme: Any) -> None:
    # `limits` is right when it is connected, and raises when the points are checked.
    change(
        acme,
        "x",
        "        own, limited_by = self._settings",
        "        self.asked = getattr(self, 'asked', 0) + 1\n"
        "        1 / (3 - min(self.asked, 3))\n"
        "        own, limited_by = self._settings",
    )
    done = dry_run(acme)
    assert done.code == 1, done.stderr
    assert "error: a fault in the package acme: acme/x_driver.py line " in done.stderr
    assert "Traceback (most recent call last)" in done.stderr
    assert "rig.log" not in done.stderr


@pytest.mark.thorough
def test_an_exception_in_a_driver_during_a_trial_names_its_package(acme: Any) -> None:
    change(acme, "x", "        self._target = position_mm\n", "        1 / 0\n")
    done = dry_run(acme)
    assert done.code == 1, done.stderr
    assert "error: a fault in the package acme: acme/x_driver.py line " in done.stderr
    assert "ZeroDivisionError: division by zero" in done.stderr
    assert "internal error" not in done.stderr
    assert z_is_lifted(acme)

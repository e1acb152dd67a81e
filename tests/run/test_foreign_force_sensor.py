"""A force sensor of another package that sends no numbers: it is named, and z is lifted.

On a simulated bench in real time, whose force sensor is driven by a package.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import packages
import pytest

from rig.bench.plan import read_bench
from rig.core.clock import WallClock

DRIVER = """
from dataclasses import replace
from typing import Literal

import drivers.me_gsv8.driver as project
import numpy as np

BAD_FROM_N = {bad_from_N}
ROLES, make_safe = ("force_sensor",), project.make_safe


class Settings(project.Settings):
    driver: Literal["acme-force"] = "acme-force"


class Amplifier(project.ForceAmplifier):
    bad = False

    def read(self):
        frames = super().read()
        if frames is None:
            return None
        self.bad |= bool(abs(frames.force_N[:, 2]).max() > BAD_FROM_N)
        return replace(frames, force_N=frames.force_N * np.nan) if self.bad else frames


def connect(settings, clock):
    amplifier = Amplifier(settings, clock)
    amplifier.prepare()
    return amplifier
"""
CLEAR_mm = 12.0
"""Position of z above which it presses nothing."""
SWEEP = ("sweep", "--no-figures", "--frequencies", "210")


@contextlib.contextmanager
def bench_with(rig: Any, bad_from_N: float) -> Iterator[Path]:
    """A bench whose force sensor sends NaN from this force along z on."""
    module = DRIVER.format(bad_from_N=bad_from_N)
    entries = "[rig.drivers]\nacme-force = acme_force\n"
    site = packages.install(rig.folder / "site", "acme", entries, {"acme_force.py": module})
    packages.on_path(rig, site)
    with rig.served() as path:
        yield path


def use_the_package(path: Path) -> None:
    path.write_text(path.read_text().replace('driver = "me-gsv8"', 'driver = "acme-force"'))


def assert_named(done: Any) -> None:
    assert done.code == 3, done.stderr
    assert re.search(
        "error: force_sensor: stream: its driver returned a force of nan N along x; check the "
        "sensor and its cable, and the driver 'acme-force' of the package acme",
        done.stderr,
    ), done.stderr
    assert "inf N" not in done.stderr


def z_at_rest(rig: Any) -> list[float]:
    """Positions at which z came to rest, in mm, as the World has them."""
    z = [e for e in rig.log() if e["device"] == "stage_z" and e["what"] == "at-rest"]
    return [float(e["value"]) for e in z]


@pytest.mark.thorough
def test_a_force_that_is_no_number_while_z_presses_ends_the_run_and_z_is_lifted(rig: Any) -> None:
    with bench_with(rig, bad_from_N=2.0) as path:
        use_the_package(path)
        done = rig.run(*SWEEP, "--bench", str(path))
        assert_named(done)
        unknown = "it is not known whether the film is still pressed"
        assert f"Bench is stopped, but {unknown} (see above): check stage_z before" in done.stderr
        assert f"and {unknown}; look before you go near it" in done.stderr
        assert "preload released" not in done.stderr
        stood = z_at_rest(rig)
        assert max(stood) > CLEAR_mm
        assert stood[-1] < CLEAR_mm


@pytest.mark.thorough
@pytest.mark.parametrize("command", [SWEEP])
def test_a_z_that_stands_in_contact_when_the_run_begins_is_lifted_although_no_force_is_known(
    rig: Any, command: tuple[str, ...]
) -> None:
    with bench_with(rig, bad_from_N=-1.0) as path:
        (z,) = (part for part in read_bench(path).instruments if part.role == "stage_z")
        with contextlib.closing(z.driver.connect(z.settings, WallClock())) as stage:
            stage.home()
            stage.move_to(12.4, 20.0)
        use_the_package(path)
        done = rig.run(*command, "--bench", str(path))
        assert_named(done)
        assert z_at_rest(rig)[-1] < CLEAR_mm, done.stderr

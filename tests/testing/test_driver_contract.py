"""The driver kit with instruments of every role that another package brings."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import packages
import pytest

HERE = Path(__file__).parent
CORES = {"stage": "Z50Core", "rotary": "R30Core", "generator": "WG1Core", "daq": "AD2Core"}
FEWEST = 14
"""Checks of a contract."""


def installed(folder: Path) -> Path:
    """Install the invented instruments; the folder that they are in."""
    modules = {f"acme/{path.name}": path.read_text() for path in (HERE / "acme").glob("*.py")}
    test = "from rig.testing import driver_contract\n"
    drivers, simulators = "[rig.drivers]\n", "[rig.simulators]\n"
    for role, core in CORES.items():
        drivers += f"acme-{role} = acme.{role}_driver\n"
        simulators += f"acme-{role} = acme.{role}_simulator:{core}\n"
        test += f"from acme.{role}_simulator import {core}\n"
        test += f'test_{role} = driver_contract("acme-{role}", core={core})\n'
    modules["test_acme.py"] = test
    return packages.install(folder, "acme", drivers + simulators, modules)


def contract(site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the contracts as their author would, in a pytest of its own."""
    start = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
    return subprocess.run(
        [*start, *options, str(site / "test_acme.py")],
        env={**os.environ, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def passed(ended: subprocess.CompletedProcess[str]) -> int:
    """How many checks have passed; an AssertionError shows the output where any has failed."""
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = re.search(r"\b(\d+) passed", ended.stdout)
    assert found is not None, ended.stdout
    return int(found[1])


@pytest.mark.thorough
def test_an_instrument_of_every_role_fulfils_its_contract(tmp_path: Path) -> None:
    assert passed(contract(installed(tmp_path / "site"))) >= FEWEST * len(CORES)


@pytest.mark.nightly
def test_instruments_fulfil_their_contract_on_the_other_kind_of_link(tmp_path: Path) -> None:
    site = installed(tmp_path / "site")
    swapped = {'"tcp"': '"serial"', '"serial"': '"tcp"'}
    roles = ("stage", "daq", "rotary")
    for role in roles:
        simulator = site / "acme" / f"{role}_simulator.py"
        text = simulator.read_text()
        (link,) = (one for one in swapped if f", {one}" in text)
        simulator.write_text(text.replace(link, swapped[link]))
        driver = site / "acme" / f"{role}_driver.py"
        resync = 'settings.timeout_s, clock, resync=("ID?", r"ACME .*"))'
        driver.write_text(driver.read_text().replace("settings.timeout_s, clock)", resync))
    chosen = " or ".join(f"test_{role}" for role in roles)
    assert passed(contract(site, "-k", chosen)) >= FEWEST * len(roles)


MISTAKES = {
    "an amplitude": (
        "generator",
        "VOLT {amplitude_V:.9G}",
        "VOLT {2 * amplitude_V:.9G}",
        "the peak amplitude is 1 V; it must be 0.5 V within 5e-06 V",
    ),
    "a direction": (
        "stage",
        "return self._state()[2]",
        "return -self._state()[2]",
        "position_mm() is -",
    ),
    "an order of samples": (
        "daq",
        "both[:, columns]",
        "both[::-1, columns]",
        "the samples do not rise one after the other",
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_shown_in_words_without_rewritten_assertions(
    tmp_path: Path, mistake: str
) -> None:
    role, right, wrong, words = MISTAKES[mistake]
    site = installed(tmp_path / "site")
    driver = site / "acme" / f"{role}_driver.py"
    text = driver.read_text()
    assert right in text
    driver.write_text(text.replace(right, wrong).replace("self._verify(word, got, wanted)", "pass"))
    ended = contract(site, "--assert=plain", "-k", f"test_{role} and whole_experiment")
    assert ended.returncode == 1
    assert words in ended.stdout

"""Importing the model or the command line must not import what is expensive."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("rig.physics", {"numpy", "numba", "scipy", "skfem"}),
        ("rig.physics.skin", {"numpy", "numba", "scipy", "skfem"}),
        ("rig.physics.trials", {"numba", "scipy", "skfem", "matplotlib"}),
        ("rig.cli.commands.skin", {"numpy", "numba", "scipy", "skfem", "matplotlib"}),
        pytest.param(
            *("rig.physics.loading_history", {"numba", "scipy", "skfem", "matplotlib"}),
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            *("rig.figures.skin", {"numba", "scipy", "skfem"}), marks=pytest.mark.thorough
        ),
    ],
)
def test_an_import_brings_nothing_expensive(module: str, absent: set[str]):
    script = f"import {module}, sys; print(*sorted(set(sys.modules) & {absent!r}))"
    found = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == []

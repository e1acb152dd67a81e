"""Trials on the skin as a run would record them: strips that are quiet, armed and then slip."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import recorded_run as run

from rig.files.journal.layout import Layout, Trace
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run

RATE_HZ = 1000.0
SLIP_S = 0.9
"""Where `slipping` has its impulse."""
LAYOUT = Layout(
    definition="NXrig_slip_trial",
    version="1",
    columns=(),
    plots=(),
    traces=(Trace("data", "signals", "v_d", ("v_1", "v_2"), title="Differential PVDF signal"),),
)


def quiet(rows: int = 1500, seed: int = 1) -> np.ndarray:
    """v_1 and v_2 in V of strips that nothing happens to: noise of 0.1 mV."""
    return 1e-4 * np.random.default_rng(seed).standard_normal((rows, 2))


def slipping(rows: int = 1500, seed: int = 1) -> np.ndarray:
    """The same with a press that both strips feel alike, then against each other a hump that arms
    and, 0.1 s after its begin, an impulse."""
    t = np.arange(rows) / RATE_HZ
    hump = 3e-3 * np.sin(np.pi * np.clip((t - SLIP_S + 0.1) / 0.2, 0, 1))
    since = t - SLIP_S
    impulse = np.where(since >= 0, np.exp(-np.clip(since, 0, None) / 0.01), 0.0)
    half = (hump + 40e-3 * impulse * np.cos(2 * np.pi * 250 * since)) / 2
    pressed = -8e-3 * np.sin(np.pi * np.clip((t - 0.35) / 0.3, 0, 1))
    return quiet(rows, seed) + pressed[:, None] + half[:, None] * np.array([1.0, -1.0])


def write_trials(
    journal: Path,
    trials: Mapping[str, np.ndarray],
    *,
    missing: int = 0,
    rate_Hz: float = RATE_HZ,
    units: str = "V",
    complete: bool = True,
    **changes: Any,
) -> Path:
    """The run file of these trials; of each, `missing` rows were lost after the first 700."""
    header = run.header(
        procedure="slip-trial",
        layout=LAYOUT.to_json(),
        title="slip-trial on bench simulated",
        points=list(trials),
        streams=[
            {"name": "signals", "device": "computed", "channels": ["v_d", "v_1", "v_2"],
             "dtype": "<f8", "row_shape": [3], "units": "V", "long_name": "strips"},
        ],
    ) | changes  # fmt: skip
    with JournalWriter.create(journal, header) as writer:
        for name, volts in trials.items():
            writer.point_begin(name, {})
            writer.stream(
                {"stream": 0, "rate_Hz": rate_Hz, "scale": [1.0] * 3, "offset": [0.0] * 3,
                 "units": units}
            )  # fmt: skip
            rows = np.column_stack([volts[:, 0] - volts[:, 1], volts])
            writer.block(0, 0, 0.0, rows[:700])
            writer.block(0, 700 + missing, 0.7, rows[700 + missing :])
            writer.point_keep(name, {})
        writer.end(run.end("complete" if complete else "stopped", len(trials)))
    return compile_run(journal, retire=complete)

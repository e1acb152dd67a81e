"""A trial on the skin with all kinds of streams, as a run would record them: raw counts, values
with a rate, and values at the times of another stream. The skin slides from 0.05 s on, grossly from
0.15 s on, and rests from 0.45 s on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import recorded_run as run

from rig.analysis.trial.friction import friction
from rig.files.journal.layout import Column, Layout, Trace
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run

COUNTS_V = 3.8e-5
TRIALS = ("trial-001", "trial-002")
LAYOUT = Layout(
    definition="NXrig_slip_trial",
    version="2",
    columns=(
        Column("slide_from", "s", "Begin of the slide"),
        Column("slide_to", "s", "End of the slide"),
        Column("kinetic_friction", "", "Kinetic friction"),
    ),
    plots=(),
    traces=(
        Trace("data", "signals", "v_d", ("v_1", "v_2"), title="Differential PVDF signal"),
        Trace("force", "force", "F_n", ("F_t",), title="Forces"),
        Trace("position", "position", "x", ("z",), title="Positions"),
    ),
)


def stream(name: str, channels: str, units: str, dtype: str = "<f8", **more: str) -> dict[str, Any]:
    names = channels.split()
    shape = {"row_shape": [len(names)], "long_name": name}
    return {"name": name, "device": name, "channels": names, "dtype": dtype, "units": units} | (
        shape | more
    )


STREAMS = (
    stream("strips", "strip_1 strip_2", "count", "<i2"),
    stream("signals", "v_d v_1 v_2", "V"),
    stream("force", "F_n F_t F_y", "N"),
    stream("position", "x z", "mm", times="ticks"),
    stream("ticks", "elapsed", "s"),
)
SLIDE_S = (0.05, 0.45)
PEAK_S = 0.15
RATES_Hz = {"strips": 1e4, "signals": 1e3, "force": 1e3}


def samples(name: str, trial: int) -> np.ndarray:
    """The rows of a stream in a trial of 0.5 s, (n, channels). Ticks come late by a few ms."""
    random = np.random.default_rng([trial, len(name)])
    ticks_s = 0.01 * np.arange(50) + random.uniform(0, 0.003, 50)
    if name == "strips":
        return random.integers(-700, 700, (5000, 2), dtype=np.int16)
    if name == "ticks":
        return ticks_s[:, None]
    if name == "position":
        return np.column_stack([10 + 0.5 * slid_s(ticks_s), np.full(50, 3.25)])
    rows = random.standard_normal((500, 3)) * 1e-3
    if name != "force":
        return rows
    t = np.arange(500) / RATES_Hz["force"]
    rises = 0.68 * slid_s(t) / (PEAK_S - SLIDE_S[0])
    slides = 0.65 + 0.03 * np.exp((PEAK_S - t) / 0.01)
    ratio = np.where(t < PEAK_S, rises, np.where(t < SLIDE_S[1], slides, 0.5))
    return rows + np.column_stack([np.full(500, 4.0), 4.0 * ratio, np.zeros(500)])


def slid_s(t: np.ndarray) -> np.ndarray:
    """The time for which the skin has slid."""
    return np.clip(t, *SLIDE_S) - SLIDE_S[0]


def reading(trial: int) -> dict[str, float]:
    """What the program finds in a trial, by the positions of its ticks."""
    t = np.arange(500) / RATES_Hz["force"]
    held = (t >= SLIDE_S[0]) & (t <= SLIDE_S[1])
    normal, tangential, _ = samples("force", trial)[held].T
    ticks_s, x = samples("ticks", trial)[:, 0], samples("position", trial)[:, 0]
    found = friction(normal, tangential, np.interp(t[held], ticks_s, x))
    return {
        "slide_from_s": SLIDE_S[0],
        "slide_to_s": SLIDE_S[1],
        "kinetic_friction": found.kinetic.value,
    }


def write_skin(journal: Path, trials: tuple[str, ...] = TRIALS) -> Path:
    """The run file of these trials."""
    header = run.header(
        procedure="slip-trial",
        layout=LAYOUT.to_json(),
        title="slip-trial on bench simulated",
        points=list(trials),
        streams=list(STREAMS),
    )
    with JournalWriter.create(journal, header) as writer:
        for number, name in enumerate(trials):
            writer.point_begin(name, {})
            for k, one in enumerate(STREAMS):
                rows, width = samples(one["name"], number), len(one["channels"])
                raw = one["units"] == "count"
                state = {
                    "stream": k,
                    "scale": [COUNTS_V if raw else 1.0] * width,
                    "offset": [0.01 if raw else 0.0] * width,
                    "units": "V" if raw else one["units"],
                }
                rate = {"rate_Hz": RATES_Hz[one["name"]]} if one["name"] in RATES_Hz else {}
                writer.stream(state | rate)
                writer.block(k, 0, 0.0, rows)
            writer.point_keep(name, reading(number))
        writer.end(run.end("complete", len(trials)))
    return compile_run(journal)

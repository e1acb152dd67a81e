"""A small sweep as a run would record it: header, readings, samples."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rig.files.journal.layout import Column, Layout, Plot
from rig.files.journal.writer import JournalWriter

LAYOUT = Layout(
    definition="NXrig_sweep",
    version="1.0",
    columns=(
        Column("frequency", "Hz", "Frequency"),
        Column("gain", "dB", "Gain"),
        Column("gain_standard_error", "dB", "Gain error", key="gain_error_dB"),
        Column("phase", "deg", "Phase"),
        Column("coherence", "1", "Coherence"),
        Column("remark", "", "Remark", "text"),
    ),
    plots=(
        Plot(
            "data",
            "gain",
            ("frequency",),
            errors="gain_standard_error",
            log_axes=("frequency",),
            title="Gain of the film",
        ),
        Plot("phase", "phase", ("frequency",), log_axes=("frequency",)),
        Plot("coherence", "coherence", ("frequency",), log_axes=("frequency",)),
    ),
)

FREQUENCIES = (10.0, 20.5, 40.0, 80.0, 160.0)
POINTS = tuple(f"f={frequency:g} Hz,lo=1 N" for frequency in FREQUENCIES)
BENCH_TOML = "[stage]\nspeed_mm_s = 1.0  # µm are too small\n"


def header(**changes: Any) -> dict[str, Any]:
    """The header of a simulated sweep over FREQUENCIES."""
    return {
        "format": 1,
        "procedure": "sweep",
        "layout": LAYOUT.to_json(),
        "title": "Sweep of strip A",
        "run_uuid": "6d1f3a52-7a07-4d7b-9c4a-3a5f6c1a2b3c",
        "collection": None,
        "start_time": "2026-11-21T22:00:00+01:00",
        "program": {"name": "rig", "version": "0.1.0", "configuration": "abc123+dirty"},
        "settings": {"load": {"peak_N": 1.0, "hold": True}, "frequencies_Hz": [10, 20.5], "n": 3},
        "setting_units": {"load.peak_N": "N", "frequencies_Hz": "Hz"},
        "fingerprint": "f" * 64,
        "bench_toml": BENCH_TOML,
        "bench_file": "bench.toml",
        "simulated": True,
        "seed": 7,
        "points": list(POINTS),
        "user": {"name": "A. Person", "email": "a@example.org"},
        "sample": {"name": "strip A", "thickness_um": 28.0},
        "notes": "",
        "instruments": [
            {"name": "stage", "role": "linear_stage", "vendor": "Festo", "model": "CMMT-AS",
             "serial_number": "1", "firmware": "29", "driver": "festo-cmmt", "simulated": True},
            {"name": "generator", "role": "signal_generator", "vendor": "Keysight",
             "model": "33522B", "simulated": True},
            {"name": "daq", "role": "data_acquisition", "vendor": "Keysight",
             "model": "U2331A", "simulated": True},
        ],
        "calibrations": [
            {"sensor": "force", "date": "2026-01-01", "coefficients": [0.1, 2.0],
             "matrix": [[80.0, 0.5, 0.0], [0.0, 81.0, -0.25]], "rows": [[1.0], [2.0, 3.0]]},
        ],
        "streams": [
            {"name": "daq", "device": "daq", "channels": ["strip_a", "force"], "dtype": "<i2",
             "row_shape": [2], "units": "count", "long_name": "strips"},
        ],
    } | changes  # fmt: skip


def state(rate: float = 1000.0, **changes: Any) -> dict[str, Any]:
    """How the stream's counts read."""
    return {
        "stream": 0,
        "rate_Hz": rate,
        "scale": [3.0517578125e-4, 1.52587890625e-4],
        "offset": [0.0, 0.1],
        "units": "V",
        "delay_s": [0.0, 4e-6],
        "range": [10.0, 5.0],
    } | changes


def reading(number: int) -> dict[str, Any]:
    """The reading of a point."""
    frequency = FREQUENCIES[number % len(FREQUENCIES)]
    return {
        "frequency_Hz": frequency,
        "gain_dB": -20.0 + 0.1 * number,
        "gain_error_dB": math.nan if number == 2 else 0.01,
        "phase_deg": 90.0 / 7.0 * number,
        "coherence": 1.0,
        "remark": "µ-slip" if number == 1 else None,
    }


def samples(number: int, rows: int = 500) -> np.ndarray:
    """The raw counts of a point, int16 of shape (rows, 2)."""
    return np.random.default_rng([1, number]).integers(-(2**15), 2**15, (rows, 2), dtype=np.int16)


def take_point(journal: Any, number: int, rows: int = 500, prefix: str = "") -> None:
    """Record one whole point through a JournalWriter, or a Recorder with prefix="put_"."""
    put = {
        name: getattr(journal, prefix + name)
        for name in ("point_begin", "point_keep", "stream", "block")
    }
    put["point_begin"](POINTS[number], {"time": 1.0 * number, "moves": [0.1]})
    put["stream"](state(rate=1000.0 * (1 + number)))
    data = samples(number, rows)
    half = rows // 2
    put["block"](0, 0, 1.0 * number + 0.1, data[:half])
    put["block"](0, half, 1.0 * number + 0.2, data[half:])
    put["point_keep"](POINTS[number], reading(number))


def event(time: float = 0.0, message: str = "armed") -> dict[str, Any]:
    """An event."""
    return {"time": time, "level": "info", "code": "state", "message": message}


def end(status: str = "complete", points: int = len(POINTS), **changes: Any) -> dict[str, Any]:
    """The run's end."""
    return {
        "status": status,
        "reason": "" if status == "complete" else "operator",
        "attempt": 1,
        "end_time": "2026-11-21T22:00:07+01:00",
        "duration_s": 7.25,
        "points_done": points,
        "warnings": [],
        "exit": 0,
    } | changes


def write_run(path: Path, order: tuple[int, ...] = (3, 0, 4, 1, 2), **changes: Any) -> Path:
    """A complete journal whose points were taken in that order; gives its path."""
    with JournalWriter.create(path, header(**changes)) as journal:
        journal.event(event())
        journal.block(0, 0, 0.05, samples(99, 20))
        for number in order:
            take_point(journal, number)
        journal.event(event(6.0, "done"))
        journal.end(end(points=len(order)))
        journal.sync()
    return path


WRITER = """
import sys
sys.path.insert(0, sys.argv[2])
import recorded_run as run
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter
recorder = Recorder(JournalWriter.create(sys.argv[1], run.header()))
recorder.put_point_begin("p", {})
for n in range(10**6):
    recorder.put_block(0, 100 * n, 0.01 * n, run.samples(n % 7, 100))
    if n % 5 == 4:
        recorder.barrier()
        print(100 * (n + 1), flush=True)
"""


def start_writer(path: Path) -> subprocess.Popen[str]:
    """A process that writes to a new journal until it is killed; every line that it prints is how
    many rows are acknowledged."""
    command = [sys.executable, "-c", WRITER, str(path), str(Path(__file__).parent)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

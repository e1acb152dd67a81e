"""Run files of a trial with strips, made without a bench."""

import json
from pathlib import Path

import numpy as np

from rig.files.journal.layout import Column, Layout, Plot
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run


def slip_file(
    folder: Path,
    name: str = "slip",
    *,
    procedure: str = "slip-trial",
    sample: str = "skin",
    day: str = "2026-11-21",
    simulated: bool = True,
    gain: float = 1.0,
    rate_Hz: float = 1000.0,
) -> Path:
    """A run file of one trial of 3000 rows, at 1 kHz a hump from 1.0 s on and a burst at 1.5 s. It
    has a truth where it is simulated, and else when its motion began."""
    layout = Layout(
        definition="NXrig_slip_trial",
        version="1",
        columns=(Column("trial", "", "Trial"), Column("speed", "mm/s", "v", long_name="v")),
        plots=(Plot("data", "speed", ("trial",)),),
    )
    time = np.arange(3000) / 1000
    noise = 1e-4 * np.random.default_rng(5).standard_normal((3000, 2))
    hump = 0.015 * np.exp(-(((time - 1.5) / 0.2) ** 2))
    burst = 0.02 * np.sin(2 * np.pi * 200 * (time - 1.5)) * ((time >= 1.5) & (time < 1.51))
    v_1, v_2 = gain * (noise + np.outer(hump + burst, [0.5, -0.5])).T
    truth = {
        "ridge": 1, "slide_us": 11_100_000, "first_slip_us": [11_400_000],
        "whole_slip_us": [11_500_000], "gross_slip_us": 11_700_000, "record_begun_us": 10_000_000,
        "ridge_lift_off_us": [10_200_000],
    }  # fmt: skip
    header = {
        "format": 1, "procedure": procedure, "layout": layout.to_json(), "title": "Slip",
        "run_uuid": "6d1f3a52-7a07-4d7b-9c4a-3a5f6c1a2b3c", "collection": None,
        "start_time": f"{day}T22:00:00+01:00",
        "program": {"name": "rig", "version": "0.1.0", "configuration": "abc123"},
        "settings": {}, "setting_units": {}, "fingerprint": "f" * 64, "bench_toml": "",
        "bench_file": "bench.toml", "simulated": simulated, "seed": 7, "points": ["trial-001"],
        "user": {"name": "A. Person"}, "sample": {"name": sample}, "notes": "",
        "instruments": [], "calibrations": [],
        "streams": [{
            "name": "signals", "device": "computed", "channels": ["v_d", "v_1", "v_2"],
            "dtype": "<f8", "row_shape": [3], "units": "V", "long_name": "signals",
        }],
    }  # fmt: skip
    state = {"stream": 0, "rate_Hz": rate_Hz, "scale": [1.0] * 3, "offset": [0.0] * 3,
             "units": "V", "delay_s": [0.0] * 3, "range": [10.0] * 3}  # fmt: skip
    end = {"status": "complete", "reason": "", "attempt": 1, "duration_s": 3.0, "points_done": 1,
           "end_time": "2026-11-21T22:00:07+01:00", "warnings": [], "exit": 0}  # fmt: skip
    with JournalWriter.create(folder / f"{name}.rigj", header) as journal:
        journal.point_begin("trial-001", {})
        journal.stream(state)
        journal.block(0, 0, 0.0, np.column_stack([v_1 - v_2, v_1, v_2]))
        known = {"simulated_truth": json.dumps(truth)} if simulated else {"motion_from_s": 1.0}
        journal.point_keep("trial-001", {"trial": 1, "speed_mm_s": 1.0, **known})
        journal.end(end)
        journal.sync()
    return compile_run(folder / f"{name}.rigj")

"""What is read from the run file of a trial on the simulated bench, and how it is stored."""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.detector.notices import Notice, from_text, notices_in, to_text
from rig.evaluation import simulated_truth
from rig.evaluation.scoring.outcomes import Truth
from rig.evaluation.scoring.patterns import roll_pattern
from rig.files.runfile.reader import RunFile

Floats = NDArray[np.float64]

TIMES = ("motion_s", "node_slip_s", "ridge_slip_s", "gross_slip_s", "lift_off_s")


@dataclass(frozen=True)
class WireRecord:
    """A trial that was made: what a detector sees, and the truth that it does not see."""

    volts: Floats
    """Signals v_1 and v_2 in V, (n, 2)."""
    rate_Hz: float
    """Sampling rate of the rows, in samples/s."""
    truth: Truth
    """What happened, from the World's own account."""
    way_mm: float | None
    """Way of x from its start to the slip of the whole ridge; None without one."""
    tick_from_s: float
    """Begin of a tick of the servo, in s of the record."""
    traits: dict[str, float | str]
    """What the record shows in addition to what was drawn."""
    slips_s: tuple[tuple[float, float], ...] = ()
    """Begin and end of every slip of the whole ridge, the first included, in s of the record."""
    notices: tuple[Notice, ...] = ()
    """What was commanded, as the detector of the trial was given it."""


def read_record(path: Path) -> WireRecord:
    """Return the record of the only trial of a run file. Raises ValueError for any file but that of
    one uninterrupted trial on a simulated bench."""
    with RunFile.open(path) as run:
        if run.outcome.simulated is not True:
            raise ValueError(f"{path.name} was not made on a simulated bench")
        points = run.point_ids()
        if len(points) != 1:
            raise ValueError(f"{path.name} has {len(points)} trials, not one")
        (point,), (reading,) = points, run.readings()
        waves = [wave for wave in run.waveforms(point) if wave.stream == "signals"]
        if len(waves) != 1:
            raise ValueError(f"{path.name} has no uninterrupted signals")
        (wave,) = waves
        volts = np.column_stack([wave.values("v_1"), wave.values("v_2")])
        assert wave.rate_Hz is not None
        record_s = len(volts) / wave.rate_Hz
        times = simulated_truth.times_of(reading, record_s)
        if not times:
            raise ValueError(f"{path.name} has no account of a simulated World")
        ends_s = simulated_truth.motion_end_of(run, point, reading)
        procedure = run.header.procedure
        truth = Truth(
            label=simulated_truth.label_of(times, procedure, ends_s),
            **{name: math.nan if times[name] is None else float(times[name]) for name in TIMES},  # type: ignore[arg-type]
            record_s=record_s,
            quiet_s=simulated_truth.quiet_of(times, run.settings, reading, ends_s, record_s),
        )
        begins = ("motion_from_s", "slide_from_s", "roll_from_s")
        tick_from_s = next(float(reading[name]) for name in begins if reading.get(name) is not None)
        traits: dict[str, float | str] = {
            "force_error_rms_percent": reading["force_error_rms_percent"]
        }
        if procedure == simulated_truth.ROLL:
            traits["pattern"] = roll_pattern(volts, wave.rate_Hz, truth.motion_s)
        way_mm = _way_mm(run, point, truth.ridge_slip_s)
        slips_s = simulated_truth.slips_of(reading, record_s)
        notices = tuple(notices_in(reading))
        return WireRecord(volts, wave.rate_Hz, truth, way_mm, tick_from_s, traits, slips_s, notices)


def _way_mm(run: RunFile, point: str, slip_s: float) -> float | None:
    """Return how far x had come when the ridge slipped."""
    axes = {wave.stream: wave for wave in run.waveforms(point)}
    if not math.isfinite(slip_s) or "ticks" not in axes:
        return None
    x_mm = axes["position"].values("x")
    return float(abs(np.interp(slip_s, axes["ticks"].values("elapsed"), x_mm) - x_mm[0]))


def pack(record: WireRecord) -> bytes:
    """Return a record as bytes, its volts to seven digits."""
    truth = record.truth
    said: dict[str, Any] = {
        "label": truth.label,
        **{name: getattr(truth, name) for name in TIMES},
        "record_s": truth.record_s,
        "quiet_s": truth.quiet_s,
        "rate_Hz": record.rate_Hz,
        "way_mm": record.way_mm,
        "tick_from_s": record.tick_from_s,
        "traits": record.traits,
        "slips_s": record.slips_s,
        "commands": to_text(record.notices),
    }
    buffer = io.BytesIO()
    volts = record.volts.astype(np.float32)
    np.savez_compressed(buffer, volts=volts, said=np.array(json.dumps(said)))
    return buffer.getvalue()


def unpack(content: bytes) -> WireRecord | None:
    """Return the record that `pack` made these bytes of, None for any others."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            said, volts = json.loads(str(stored["said"])), stored["volts"].astype(np.float64)
        truth = Truth(
            label=said["label"],
            **{name: float(said[name]) for name in TIMES},
            record_s=said["record_s"],
            quiet_s=tuple((begin, end) for begin, end in said["quiet_s"]),
        )
        return WireRecord(
            volts, said["rate_Hz"], truth, said["way_mm"], said["tick_from_s"], said["traits"],
            tuple((begin, end) for begin, end in said["slips_s"]),
            tuple(from_text(said["commands"])),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None

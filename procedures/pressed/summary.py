"""The summary of a run of trials with the skin pressed on an object.

How many trials are valid, means over them, the slips that were found, and what a simulated bench
put in.
"""

from __future__ import annotations

import json
import math
import statistics
from typing import TYPE_CHECKING, Any

from procedures.pressed.approach.tare import ZERO_LABEL, force_zero_of
from rig.bench.settings import STRIPS
from rig.core.settings import name_without_unit
from rig.files.journal.detections import SLIP, from_text
from rig.files.journal.layout import TRUTH
from rig.run.procedure import DriftFigure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.run.points import Reading

TOUCH_DRIFT = {
    f"mean_touch_gain_{number}_dB": DriftFigure("gain by touch-down and tap", strip, 0.5)
    for number, strip in enumerate(STRIPS, 1)
}
"""Five times the largest difference that was seen on the simulated bench (decision 0051)."""
SUMMARY_LABELS = {
    "tick_Hz": "servo tick rate; Hz",
    "mean_touch_gain_1_dB": "strip 1, touch-down gain; dB re 1 V s/N",
    "mean_touch_gain_2_dB": "strip 2, touch-down gain; dB re 1 V s/N",
    "mean_force_error_rms_percent": "error of the normal force, rms",
    "mean_force_error_peak_percent": "error of the normal force, peak",
    "force_zero_N": ZERO_LABEL,
}
"""Labels of values that are shown after a run, see `Procedure.summary_labels`."""


def summary_of(readings: Sequence[Reading], names: Sequence[str]) -> dict[str, Any]:
    """Return the number of valid trials, and the means and standard deviations of the named values
    over them."""
    valid = [r for r in readings if not r["invalid"]]
    found: dict[str, Any] = {"trials": len(readings), "valid_trials": len(valid)}
    if readings and "tick_Hz" in readings[-1]:  # not in files of earlier versions
        found["tick_Hz"] = readings[-1]["tick_Hz"]
    errors: dict[str, float] = {}
    for name in names:
        values = [float(value) for r in valid if (value := r.get(name)) is not None]
        if values:
            found[f"mean_{name}"] = statistics.fmean(values)
        if len(values) > 1:
            found[f"standard_deviation_{name}"] = statistics.stdev(values)
            errors[f"mean_{name}"] = statistics.stdev(values) / math.sqrt(len(values))
        elif values and (own := _own_error(valid, name)) is not None:
            errors[f"mean_{name}"] = own
    if errors:
        found["standard_errors"] = errors
    if (slips := _slips_of(readings))["trial"]:
        found["slips"] = slips
    put_in = {"put_in": sentences} if (sentences := _put_in(readings)) else {}
    return found | _touch_gains_of(readings) | force_zero_of(readings) | put_in


def _slips_of(readings: Sequence[Reading]) -> dict[str, list[float | None]]:
    """Return every incipient slip that the detector found during the trials: the trial, the time in
    its record, the time at which the program knew it, the confidence, and the amplitudes by which
    the detector decided, where it states them: the predictive signal P_A and the impulse P_B of
    v_d."""
    found = [
        (reading, one)
        for reading in readings
        for one in from_text(str(reading.get("detections") or ""))
        if one.kind == SLIP
    ]
    return {
        "trial": [float(reading.get("trial") or 0) for reading, _ in found],
        "time_s": [one.time_s for _, one in found],
        "decided_s": [one.decided_s for _, one in found],
        "confidence": [one.confidence for _, one in found],
        **{
            name: amplitudes
            for name in ("predictive_mV", "impulse_mV")
            if any(amplitudes := [getattr(one, name) for _, one in found])
        },
    }


def _own_error(readings: Sequence[Reading], name: str) -> float | None:
    """Return the standard error that the one reading with this value states itself, if it does."""
    (reading,) = (r for r in readings if r.get(name) is not None)
    quantity = name_without_unit(name)
    error = reading.get(f"{quantity}_error{name.removeprefix(quantity)}")
    return None if error is None else float(error)


def truth_of(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return the simulated bench's record of the latest trial that has one; empty on a real one."""
    accounts = [str(truth) for r in readings if (truth := r.get(TRUTH))]
    known: dict[str, Any] = json.loads(accounts[-1]) if accounts else {}
    return known


def _put_in(readings: Sequence[Reading]) -> list[str]:
    """Return what the simulated bench put into the trials, in words; nothing on a real one."""
    known = truth_of(readings)
    lines = []
    if (body := known.get("object", {})).get("shape") in ("cylinder", "sphere"):
        shape = f"a {body['shape']} of {body['radius_mm']:g} mm radius"
        other = ", not the paper's semi-spherical head" if body["shape"] == "cylinder" else ""
        lines.append(f"In the simulation the object is {shape}{other} (radius ASSUMED).")
    if "static_coefficient" in known:
        lines.append(
            f"True values in the simulation: friction {known['static_coefficient']:g} at rest, "
            f"{known['kinetic_coefficient']:g} in motion, over "
            f"{known['weakening_distance_um']:g} um (ASSUMED), and the skin: its finger radius is "
            "calibrated so that all nine ridges touch at 4 N, its other dimensions are ASSUMED "
            "where the paper gives none. When and where it slips follows from these."
        )
    return lines


def _touch_gains_of(readings: Sequence[Reading]) -> dict[str, float]:
    """Return each strip's mean gain in dB re 1 V s/N. An invalid trial was pressed all the same."""
    found = {}
    for number in (1, 2):
        name = f"touch_gain_{number}_V_s_N"
        gains = [float(gain) for r in readings if (gain := r.get(name)) is not None]
        if gains and (mean := statistics.fmean(gains)):
            found[f"mean_touch_gain_{number}_dB"] = 20 * math.log10(abs(mean))
    return found

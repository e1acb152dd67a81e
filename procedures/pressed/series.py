"""What the trials of one run share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rig.analysis.trial.load_rate import LoadScale, amplifier_dB, load_scale, load_scale_of_record
from rig.bench.settings import STRIPS

if TYPE_CHECKING:
    from procedures.pressed.rates import ServoRates
    from rig.run.context import Run


@dataclass
class PressedSeries:
    """What the stages allow, and what the trials of a series have taught the ones that follow."""

    rates: ServoRates
    scales: dict[str, LoadScale] = field(default_factory=dict)
    """Of the strips that are calibrated."""
    contact_mm: float | None = None
    """Position of z at which the object was felt last."""


def load_scales_for(run: Run) -> dict[str, LoadScale]:
    """Return the load rate by volt of every calibrated strip; warn of those that are not."""
    skin, scales = run.bench.skin, dict[str, LoadScale]()
    for strip in STRIPS:
        record = run.bench.strip_calibrations.get(strip)
        if record is not None:
            scales[strip] = load_scale_of_record(record, skin.amplifier_gain)
        elif strip in skin.b_dB:
            level_dB = skin.b_dB[strip] + amplifier_dB(skin.amplifier_gain)
            scales[strip] = load_scale(level_dB, skin.b_error_dB[strip])
    if missing := [strip for strip in STRIPS if strip not in scales]:
        run.event(
            "warning",
            "calibration",
            f"{' and '.join(missing)} of the skin: not calibrated, so volts are not told as load "
            "rate; name the records in [calibrations] of the bench file",
        )
    return scales

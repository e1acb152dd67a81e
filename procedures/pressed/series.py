"""State that the trials of one run share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rig.analysis.trial.load_rate import LoadScale, amplifier_dB, load_scale, load_scale_of_record
from rig.bench.settings import STRIPS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from procedures.pressed.approach.torque_watch import TorqueWatch
    from procedures.pressed.rates import ServoRates
    from procedures.pressed.record.detection import LiveDetection
    from rig.run.context import Run


def _strips(names: Sequence[str]) -> str:
    """Return ``strips 1 and 2 have`` or ``strip 1 has`` for names such as ``strip_1``."""
    numbers = [name.removeprefix("strip_") for name in names]
    return (
        f"strip {numbers[0]} has" if len(numbers) == 1 else f"strips {' and '.join(numbers)} have"
    )


@dataclass
class PressedSeries:
    """State of a series: the rates that the stages allow, and what earlier trials measured."""

    rates: ServoRates
    scales: dict[str, LoadScale] = field(default_factory=dict)
    """Load rate by volt of each calibrated strip."""
    contact_mm: float | None = None
    """Position of z at which the object was felt last."""
    detection: LiveDetection | None = None
    """The detector that runs during the trials; None before the first arming."""
    torque: TorqueWatch | None = None
    """Torque of z in this run; None before the first trial."""
    block_s: float | None = None
    """Length in s of the DAQ's blocks, where those of the settings are too short for its link."""
    way_is_clear: bool = False
    """Whether z has gone down to just above the earliest contact since the run was armed."""


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
            f"{_strips(missing)} no calibration record, so signals are stored in volts only. To "
            "get load rate (N/s), calibrate the films (rig calibrate pvdf) and list the records "
            "under [calibrations] of the bench file",
        )
    return scales

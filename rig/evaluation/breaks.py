"""Conditions in which a detector may break, one by one: what is drawn for each of them.

Each break is a population of trials of its own (`rig.evaluation.scored_trials.Population`), so that
any detector is scored on it like on all others. What a break does not state is as in the reference
skin's population and front end. All values are assumed.

    >>> sorted(BREAKS)[:3]
    ['1/f noise', 'AC coupling at 0.3 Hz', 'ADC steps of 1 mV']
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rig.evaluation.labelled_trials import Kind
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings


@dataclass(frozen=True)
class Break:
    """The trials of one condition."""

    kinds: tuple[Kind, ...]
    """Kinds of trials: those in which slips are missed, and those in which none is there."""
    population: PopulationSettings
    """Ranges of skin, contact and motion."""
    front_end: StripFrontEndSettings
    """Ranges of the front end."""


SLIPS_AND_HOLDS: tuple[Kind, ...] = ("slide", "hold")
YOUNGS_MPa = 1.7
"""Young's modulus of the reference skin."""


def between(low: float, high: float) -> Range:
    """Return a range from which the logarithm is drawn evenly, or a value if both are the same."""
    return Range(low=low, high=high, logarithmic=low > 0)


def contact_break(kinds: tuple[Kind, ...], **ranges: Any) -> Break:
    """Return a break of skin, contact or motion: what it changes in the population."""
    whole = PopulationSettings().model_dump() | ranges
    population = PopulationSettings.model_validate(whole)
    return Break(kinds, population, StripFrontEndSettings())


def front_end_break(**ranges: Any) -> Break:
    """Return a break of amplifiers or converter, heard in slides and holds."""
    whole = StripFrontEndSettings().model_dump() | ranges
    front_end = StripFrontEndSettings.model_validate(whole)
    return Break(SLIPS_AND_HOLDS, PopulationSettings(), front_end)


def _skin(**changes: Any) -> dict[str, Any]:
    return {**PopulationSettings().skin.model_dump(), **changes}


BREAKS: dict[str, Break] = {
    "none": contact_break(("slide", "hold", "roll", "tap")),
    "shear to and fro": contact_break(("reversal",)),
    "tremor of 5 to 12 Hz": contact_break(("tremor",)),
    "falling normal force": contact_break(("falling force",)),
    "firmer grip": contact_break(("re-grip",)),
    "lift-off": contact_break(("lift-off",)),
    "several slips": contact_break(("again",)),
    "slides of 0.1 to 0.3 mm/s": contact_break(SLIPS_AND_HOLDS, speed_mm_s=between(0.1, 0.3)),
    "friction falls by 0 to 3 %": contact_break(
        SLIPS_AND_HOLDS, friction_ratio=Range(low=0.97, high=1.0)
    ),
    "strips 0.1 mm inward": contact_break(
        SLIPS_AND_HOLDS, skin=_skin(strips={"offset_mm": 0.25})
    ),
    "rubber twice as stiff": contact_break(
        SLIPS_AND_HOLDS, skin=_skin(youngs_modulus_MPa=2 * YOUNGS_MPa)
    ),
    "stage vibration of 20 to 80 Hz": contact_break(
        SLIPS_AND_HOLDS, jitter_um=Range(low=0.5, high=2.0), jitter_Hz=between(20.0, 80.0)
    ),
    "servo ticks of 50 to 500 Hz": contact_break(
        SLIPS_AND_HOLDS, tick_share=between(0.003, 0.02)
    ),
    "abrupt stops": contact_break(("hold",), ramp_s=between(0.001, 0.005)),
    "holds at 60 to 98 % of the way": contact_break(
        ("hold",), held_share=Range(low=0.6, high=0.98)
    ),
    "AC coupling at 0.3 Hz": front_end_break(coupling_Hz=between(0.3, 0.3)),
    "1/f noise": front_end_break(flicker_mV=between(0.5, 2.0)),
    "white noise of 3 mV": front_end_break(noise_mV=between(3.0, 3.0)),
    "ADC steps of 1 mV": front_end_break(step_mV=between(1.0, 1.0)),
    "bursts": front_end_break(bursts_Hz=between(2.0, 2.0)),
    "gains times a quarter": front_end_break(gain=between(0.25, 0.25)),
    "gains times four": front_end_break(gain=between(4.0, 4.0)),
    "pyroelectric drift": front_end_break(drift_mV=between(5.0, 30.0)),
}  # fmt: skip
"""The breaks by name; ``none`` is the population as it is."""

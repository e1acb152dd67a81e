"""The design question of the paper: where should the transducers lie, and which stress should they
measure?

One reference slide is simulated. Its contact forces are then converted to the stress that strips at
many places would have felt, in every ridge and every component. For each place the map contains the
hump (low-frequency level of v_d before that ridge slips) and the peak (largest part of v_d above
100 Hz around the slip of that ridge).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.core.settings import Settings
from rig.physics.skin.condensed import condense_elements
from rig.physics.skin.elasticity import STRESSES, ElasticSkin, Rectangle
from rig.physics.skin.settings import SkinSettings
from rig.physics.transducer import TransducerChain
from rig.physics.trials import SkinTrial, SlideSettings, high_frequency, sample, slide

Floats = NDArray[np.float64]


class MapSettings(Settings):
    """The slide, and the places at which strips are tried."""

    skin: SkinSettings = SkinSettings(elements_per_ridge=6)
    """The skin."""
    slide: SlideSettings = SlideSettings()
    """The reference slide."""
    offsets_mm: tuple[float, ...] = (0.15, 0.25, 0.35, 0.45, 0.55)
    """Distances of the middles of the strips from the axis of the ridge."""
    bottoms_mm: tuple[float, ...] = (-0.5, 0.0, 0.3, 0.6)
    """Heights of the lower edges of the strips above the foot of the ridge."""
    strip_width_mm: float = Field(0.3, gt=0)
    """Extent of a strip along x."""
    strip_height_mm: float = Field(0.35, gt=0)
    """Height of a strip."""

    def places(self) -> list[tuple[float, float]]:
        """Return every (offset, bottom) in mm that is tried."""
        return [(offset, bottom) for bottom in self.bottoms_mm for offset in self.offsets_mm]


@dataclass(frozen=True)
class DesignMap:
    """Hump and peak in V, (ridges, bottoms, offsets, 3 components xx yy xy)."""

    settings: MapSettings
    """Slide and places of the map."""
    hump_V: Floats
    """Mean of v_d from the end of the speed ramp until 10 ms before the first event of the
    ridge."""
    peak_V: Floats
    """Largest |v_d| above 100 Hz, from 10 ms before to 20 ms after the whole ridge slips."""
    components: tuple[str, ...] = STRESSES
    """Names of the stress components."""


def design_map(settings: MapSettings) -> DesignMap:
    """Simulate the slide and return its map. Raises ValueError if a strip would leave the
    rubber."""
    elastic = ElasticSkin(settings.skin)
    skin = condense_elements(elastic)
    trial = slide(skin, settings.slide, keep_forces=True)
    ridges, places = settings.skin.ridges, settings.places()
    areas = [
        area
        for axis in settings.skin.ridge_axes_mm()
        for place in places
        for area in _pair(settings, axis, *place)
    ]
    rows = elastic.mean_stress_rows(areas) @ elastic.influence
    stress = trial.block.forces_N @ rows.T
    by_place = stress.reshape(-1, ridges * len(places), 2, 3)
    difference = (by_place[:, :, 0] - by_place[:, :, 1]).reshape(stress.shape[0], -1)
    v_d = _filtered_volts(settings.slide, difference)
    v_d = v_d.reshape(-1, ridges, len(places), 3)
    shape = (ridges, len(settings.bottoms_mm), len(settings.offsets_mm), 3)
    return DesignMap(
        settings=settings,
        hump_V=np.stack([_hump(trial, v_d[:, r], r) for r in range(ridges)]).reshape(shape),
        peak_V=np.stack([_peak(trial, v_d[:, r], r) for r in range(ridges)]).reshape(shape),
    )


def _pair(
    settings: MapSettings, axis: float, offset: float, bottom: float
) -> tuple[Rectangle, Rectangle]:
    skin = settings.skin
    half, top = settings.strip_width_mm / 2, bottom + settings.strip_height_mm
    slack = 1e-9
    beside = offset + half > skin.top_mm / 2 + slack
    if beside or top > skin.height_mm + slack or bottom < -skin.body_mm - slack:
        raise ValueError(
            f"strip at offset {offset:g} mm from {bottom:g} to {top:g} mm leaves the rubber: its "
            f"ridge reaches {skin.top_mm / 2:g} mm to each side and from {-skin.body_mm:g} to "
            f"{skin.height_mm:g} mm"
        )
    left, right = axis - offset, axis + offset
    return (
        Rectangle(left - half, left + half, bottom, top),
        Rectangle(right - half, right + half, bottom, top),
    )


def _filtered_volts(settings: SlideSettings, stress_MPa: Floats) -> Floats:
    step_s = settings.contact.step_us * 1e-6
    chain = TransducerChain(settings.transducer, step_s, channels=stress_MPa.shape[1])
    filtered, _ = sample(chain.advance(stress_MPa), step_s, settings.sample)
    return filtered


def _hump(trial: SkinTrial, v_d: Floats, ridge: int) -> Floats:
    begins = trial.motion_s + 0.06
    whole = trial.truth.whole_slip_s
    ends = np.nanmin(np.where(whole > begins + 0.02, whole, np.nan), initial=trial.time_s[-1])
    if np.isfinite(whole[ridge]):
        ends = min(ends, whole[ridge])
    window = (trial.time_s > begins) & (trial.time_s < max(ends - 0.01, begins + 0.01))
    hump: Floats = v_d[window].mean(axis=0)
    return hump


def _peak(trial: SkinTrial, v_d: Floats, ridge: int) -> Floats:
    whole = trial.truth.whole_slip_s[ridge]
    if not np.isfinite(whole):
        return np.zeros(v_d.shape[1:])
    rate = 1.0 / float(trial.time_s[1] - trial.time_s[0])
    flat = v_d.reshape(v_d.shape[0], -1)
    window = (trial.time_s > whole - 0.01) & (trial.time_s < whole + 0.02)
    fast = np.stack([high_frequency(flat[:, c], rate) for c in range(flat.shape[1])], axis=1)
    peak: Floats = np.abs(fast[window]).max(axis=0).reshape(v_d.shape[1:])
    return peak

"""What is drawn for a trial on the simulated bench: the bench's World, the procedure, its settings.

A seed draws one World (skin, strips, friction, rubber, noise, head), one normal force and one tick
rate of the servo, which all kinds of trials of the seed share; a kind draws the rest. Every seed is
another bench. Several kinds are stated as
shares of the way to slip. That way is taken from the slide of the same seed (`Limit`), which is
made first. All ranges are assumed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from rig.physics.population import (
    PopulationSettings,
    Range,
    StripFrontEndSettings,
    placed_mm,
)

WireKind = Literal[
    "slide", "ramp", "hold", "roll a", "roll b", "reversal", "tremor", "re-grip", "falling force",
    "tap", "lift-off", "rest", "re-grip in a slide",
]  # fmt: skip
"""Kinds of trials on the simulated bench. Rolls are those of Figure 19, a and b."""
WIRE_KINDS: tuple[WireKind, ...] = get_args(WireKind)

POPULATION = PopulationSettings()
"""Ranges of skin, friction, rubber and head, the same as those of labelled trials and of
benches."""
GAINS = StripFrontEndSettings()
"""Ranges of the strips' gains, likewise."""
REFERENCE_MPa = 1.7
"""Young's modulus of the skin whose ways to slip are known; a softer skin goes further."""
NOISE_V_sqrtHz = Range(low=0.5e-6, high=5e-6, logarithmic=True)
"""0.09 to 0.9 mV rms of a sample at the converter."""
MAINS_mV = Range(low=0.0, high=0.5)
FORCE_N = Range(low=0.5, high=12.0, logarithmic=True)
TICK_Hz = Range(low=50.0, high=500.0, logarithmic=True)
SPEED_mm_s = Range(low=0.1, high=20.0, logarithmic=True)
TO_AND_FRO_mm_s = Range(low=0.2, high=5.0, logarithmic=True)
RAMP_N_s = Range(low=1.0, high=30.0, logarithmic=True)
REST_s = Range(low=0.3, high=1.5)
HELD_SHARE = Range(low=0.6, high=0.98)
STAY_s = Range(low=0.4, high=1.5)
QUIET_S = 30.0
"""Length of a rest."""
SOFT_s = 0.2
"""Duration of a soft stop."""

ACCELERATION_mm_s2 = 200.0
"""Acceleration of the simulated stages."""
LARGEST_FORCE_N = 15.0
ANY_ERROR_percent = 1e3
"""Error of the force up to which a trial is valid: here every trial is scored."""


@dataclass(frozen=True)
class Limit:
    """How far the plate slid until the ridge that holds the strips slipped as a whole."""

    way_mm: float


@dataclass(frozen=True)
class WireTrial:
    """A trial to be made: everything that determines it, apart from the program's code."""

    kind: WireKind
    seed: int
    procedure: str
    """Name of the procedure."""
    settings: dict[str, Any]
    """Settings of the procedure that are not left at their defaults, by name with the unit."""
    world: dict[str, Any]
    """Settings of the simulated bench's World, as in its file."""
    traits: dict[str, float | str]
    """What was drawn, for the tables, by name and unit."""

    @property
    def name(self) -> str:
        """Kind and seed in words."""
        return f"{self.kind} {self.seed}"


def needs_limit(kind: WireKind) -> bool:
    """Return whether trials of this kind are stated as shares of the way to slip."""
    return kind not in ("slide", "ramp", "roll a", "roll b", "rest")


def drawn(kind: WireKind, seed: int, limit: Limit | None) -> WireTrial:
    """Return the trial of a kind and seed. `limit` is needed where `needs_limit` says so."""
    assert limit is not None or not needs_limit(kind)
    common = np.random.default_rng([seed, 100])
    own = np.random.default_rng([seed, WIRE_KINDS.index(kind)])
    static, ratio = (
        POPULATION.static_coefficient.draw(common),
        POPULATION.friction_ratio.draw(common),
    )
    force_N, tick_Hz = FORCE_N.draw(common), round(TICK_Hz.draw(common))
    noise_V = NOISE_V_sqrtHz.draw(common)
    friction = {
        "static_coefficient": _digits(static),
        "kinetic_coefficient": _digits(static * ratio),
        "weakening_distance_um": _digits(POPULATION.weakening_distance_um.draw(common)),
    }
    relaxation_ms = _digits(POPULATION.relaxation_time_ms.draw(common))
    mains_mV = _digits(MAINS_mV.draw(common))
    youngs_MPa = _digits(POPULATION.youngs_modulus_MPa.draw(common))
    strips_mm = placed_mm(POPULATION.strip_offset_mm.draw(common))
    mismatch = _digits(GAINS.gain_mismatch.draw(common))
    radius_mm = _digits(POPULATION.radius_mm.draw(common))
    world: dict[str, Any] = {
        "contact": {"relaxation_time_ms": relaxation_ms, "friction": friction},
        "strip_input": {"noise_density_V_sqrtHz": _digits(noise_V), "mains_amplitude_mV": mains_mV},
        "skin": {
            "elements_per_ridge": POPULATION.skin.elements_per_ridge,
            "youngs_modulus_MPa": youngs_MPa,
            "strips": {"offset_mm": strips_mm},
        },
        "skin_mount": {"ridge": POPULATION.ridge, "gain_mismatch": mismatch},
    }
    if kind in ("roll a", "roll b"):
        world["head"] = {"body": {"shape": "cylinder", "radius_mm": radius_mm}}
    settings: dict[str, Any] = {
        "normal_force_N": _digits(force_N),
        "tick_Hz": tick_Hz,
        "rest_s": _digits(REST_s.draw(own)),
        "largest_force_N": LARGEST_FORCE_N,
        "force_error_rms_percent": ANY_ERROR_percent,
        "force_error_peak_percent": ANY_ERROR_percent,
        "overshoot_percent": ANY_ERROR_percent,
    }
    traits: dict[str, float | str] = {
        "kind": kind,
        "normal_force_N": force_N,
        "tick_Hz": float(tick_Hz),
        "static_coefficient": static,
        "friction_ratio": ratio,
        "noise_mV": 1e3 * noise_V * math.sqrt(30e3),
        "youngs_modulus_MPa": youngs_MPa,
        "strip_offset_mm": strips_mm,
        "gain_mismatch": mismatch,
    }
    reach_mm = force_N * static * REFERENCE_MPa / youngs_MPa
    draw = _Draw(own, force_N, static, reach_mm, limit, settings, traits)
    procedure = _KINDS[kind](draw)
    return WireTrial(kind, seed, procedure, settings, world, traits)


@dataclass
class _Draw:
    """What the kinds draw from, and what they fill in."""

    chance: np.random.Generator
    force_N: float
    static: float
    reach_mm: float
    """Measure of the way to slip, in mm: force times friction over stiffness."""
    limit: Limit | None
    settings: dict[str, Any]
    traits: dict[str, float | str]

    @property
    def way_mm(self) -> float:
        """Way to the slip of the whole ridge."""
        assert self.limit is not None
        return self.limit.way_mm

    def trait(self, name: str, value: float) -> float:
        """Round a drawn value, record it among the traits and return it."""
        self.traits[name] = rounded = _digits(value)
        return rounded

    def sign(self) -> int:
        return 1 if self.chance.random() < 0.5 else -1

    def path(self, corners: list[tuple[float, float]], sign: int) -> None:
        """Let x follow a path, given as durations in s and ways in mm, one after the other."""
        times, positions = [0.0], [0.0]
        for duration_s, way_mm in corners:
            times.append(round(times[-1] + max(duration_s, 0.002), 5))
            positions.append(round(positions[-1] + sign * way_mm, 6))
        self.settings |= {"path_times_s": tuple(times), "path_positions_mm": tuple(positions)}

    def preload(self, share: float, soft: bool) -> list[tuple[float, float]]:
        """Return a path to a share of the way to slip, at a drawn speed."""
        speed_mm_s = self.trait("speed_mm_s", min(SPEED_mm_s.draw(self.chance), 5.0))
        way_mm = share * self.way_mm
        soft_mm = min(0.5 * way_mm, speed_mm_s * SOFT_s / 2) if soft else 0.0
        corners = [((way_mm - soft_mm) / speed_mm_s, way_mm - soft_mm)]
        # A soft stop: six pieces, each slower than the one before.
        weights = [6, 5, 4, 3, 2, 1] if soft else []
        soft_s = 2 * soft_mm / speed_mm_s
        corners += [(soft_s / 6, soft_mm * weight / sum(weights)) for weight in weights]
        return corners

    def course(self, start_s: float, corners: list[tuple[float, float]]) -> None:
        """Let the force follow a course from `start_s` on, given as durations and shares."""
        times, shares = [0.0, round(start_s, 5)], [1.0, 1.0]
        for duration_s, share in corners:
            times.append(round(times[-1] + duration_s, 5))
            shares.append(round(share, 4))
        self.settings |= {"force_times_s": tuple(times), "force_shares": tuple(shares)}


def _digits(value: float) -> float:
    return float(f"{value:.6g}")


def _slide(draw: _Draw) -> str:
    speed_mm_s = draw.trait("speed_mm_s", SPEED_mm_s.draw(draw.chance))
    # The way to gross slip on this skin, and the way in which the drive speeds up and down.
    way_mm = 0.1 + 0.13 * draw.reach_mm + speed_mm_s**2 / ACCELERATION_mm_s2
    draw.settings |= {
        "speed_mm_s": speed_mm_s,
        "distance_mm": _digits(way_mm + 0.1 * speed_mm_s),
        "direction": "+x" if draw.sign() > 0 else "-x",
    }
    return "slip-trial"


def _ramp(draw: _Draw) -> str:
    rate_N_s = draw.trait("ramp_N_s", RAMP_N_s.draw(draw.chance))
    to_N = _digits(min(1.3 * draw.static * draw.force_N, LARGEST_FORCE_N - 0.5))
    draw.settings |= {
        "loading": "ramp",
        "ramp_N_s": rate_N_s,
        "ramp_to_N": to_N,
        "speed_mm_s": _digits(min(20.0, max(0.5, rate_N_s / 5))),
        "distance_mm": _digits(0.6 + 0.2 * draw.reach_mm),
        "direction": "+x" if draw.sign() > 0 else "-x",
    }
    return "slip-trial"


def _hold(draw: _Draw) -> str:
    share = draw.trait("held_share", HELD_SHARE.draw(draw.chance))
    soft = draw.chance.random() < 0.5
    draw.traits["stop"] = "soft" if soft else "abrupt"
    draw.path(draw.preload(share, soft), draw.sign())
    draw.settings["stay_s"] = _digits(STAY_s.draw(draw.chance))
    return "path-trial"


def _reversal(draw: _Draw) -> str:
    share = draw.trait("held_share", draw.chance.uniform(0.2, 0.6))
    speed_mm_s = draw.trait("speed_mm_s", TO_AND_FRO_mm_s.draw(draw.chance))
    way_mm, turns = share * draw.way_mm, int(draw.chance.integers(2, 5))
    there_s = way_mm / speed_mm_s
    # To one side, then between both sides, and back to the middle.
    swings = [(2 * there_s, (-1) ** (turn + 1) * 2 * way_mm) for turn in range(turns)]
    draw.path([(there_s, way_mm), *swings, (there_s, (-1) ** (turns + 1) * way_mm)], draw.sign())
    return "path-trial"


def _tremor(draw: _Draw) -> str:
    share = draw.chance.uniform(0.2, 0.6)
    rate_Hz = draw.trait("tremor_Hz", draw.chance.uniform(5.0, 12.0))
    swing_mm = draw.trait("tremor_um", 1e3 * draw.chance.uniform(0.03, 0.15) * draw.way_mm) / 1e3
    half_s, count = 0.5 / rate_Hz, round(2 * rate_Hz * draw.chance.uniform(0.8, 1.6))
    shaken = [(half_s, (-1) ** turn * swing_mm) for turn in range(count)]
    draw.path([*draw.preload(share, soft=True), (0.1, 0.0), *shaken], draw.sign())
    return "path-trial"


def _firmer(draw: _Draw, share: float) -> float:
    return min(share, (LARGEST_FORCE_N - 1.5) / draw.force_N)


def _re_grip(draw: _Draw) -> str:
    """Plan a load at rest, then a firmer grip in a step as steep as the servo makes it."""
    preload = draw.preload(draw.trait("held_share", draw.chance.uniform(0.5, 0.9)), soft=False)
    draw.path(preload, draw.sign())
    rise = _firmer(draw, 1 + draw.trait("grip_share", draw.chance.uniform(0.1, 0.4)))
    loaded_s = sum(duration_s for duration_s, _ in preload)
    draw.course(loaded_s + 0.3, [(0.005, rise), (0.5, rise)])
    return "path-trial"


def _re_grip_in_a_slide(draw: _Draw) -> str:
    """Plan a slide in which the grip becomes firmer about when the ridge slips.

    A grip that answers an alarm does so: the ridge sticks again, or slides on, and slips once more.
    """
    speed_mm_s = draw.trait("speed_mm_s", min(SPEED_mm_s.draw(draw.chance), 5.0))
    way_mm = 2.0 * draw.way_mm
    draw.path([(way_mm / speed_mm_s, way_mm)], draw.sign())
    rise = _firmer(draw, 1 + draw.trait("grip_share", draw.chance.uniform(0.1, 0.4)))
    slips_s = draw.way_mm / speed_mm_s
    grips_s = draw.chance.uniform(0.9, 1.1) * slips_s + draw.chance.uniform(0.0, 0.05)
    draw.course(grips_s, [(0.005, rise), (0.5, rise)])
    return "path-trial"


def _falling_force(draw: _Draw) -> str:
    """Plan a load at rest, then a grip that loosens until the load slips or is hardly held."""
    share = draw.trait("held_share", draw.chance.uniform(0.4, 0.8))
    preload = draw.preload(share, soft=True)
    draw.path(preload, draw.sign())
    loaded_s = sum(duration_s for duration_s, _ in preload)
    least = 0.5 * share
    falls_s = draw.trait("falls_s", math.exp(draw.chance.uniform(math.log(0.15), math.log(2.0))))
    draw.course(loaded_s + 0.3, [(falls_s, least)])
    return "path-trial"


def _tap(draw: _Draw) -> str:
    """Plan a knock at rest and one under a load, each as quick as the servo makes it."""
    preload = draw.preload(draw.trait("held_share", draw.chance.uniform(0.1, 0.5)), soft=True)
    draw.path([(0.5, 0.0), *preload], draw.sign())
    rise = _firmer(draw, 1 + draw.trait("tap_share", draw.chance.uniform(0.05, 0.5)))
    loaded_s = sum(duration_s for duration_s, _ in preload)
    knock = draw.chance.uniform(0.01, 0.04)
    again = [(0.3 + loaded_s + 0.3 - 2 * knock, 1.0), (knock, rise), (knock, 1.0)]
    draw.course(0.2, [(knock, rise), (knock, 1.0), *again])
    return "path-trial"


def _lift_off(draw: _Draw) -> str:
    """Plan an object that is let go during the recording, most of it without a load."""
    share = draw.trait("held_share", draw.chance.uniform(0.0, 0.15))
    preload = draw.preload(max(share, 0.01), soft=True)
    draw.path(preload, draw.sign())
    loaded_s = sum(duration_s for duration_s, _ in preload)
    draw.course(loaded_s + 0.3, [(draw.trait("falls_s", draw.chance.uniform(0.1, 0.6)), 0.1)])
    return "path-trial"


def _rest(draw: _Draw) -> str:
    """Plan a constant force and nothing else, for the alarms per hour of quiet."""
    draw.settings["stay_s"] = QUIET_S
    return "path-trial"


def _roll(draw: _Draw, start_mm: float) -> str:
    angle_deg = _digits(3.5 * draw.chance.uniform(0.7, 1.3) * draw.sign())
    draw.settings |= {
        "angle_deg": angle_deg,
        "start_mm": start_mm,
        "turn_speed_deg_s": draw.trait("turn_speed_deg_s", draw.chance.uniform(4.0, 20.0)),
        "angle_error_deg": 1.0,
    }
    return "roll-trial"


_KINDS: dict[WireKind, Callable[[_Draw], str]] = {
    "slide": _slide,
    "ramp": _ramp,
    "hold": _hold,
    "roll a": lambda draw: _roll(draw, -6.5),
    "roll b": lambda draw: _roll(draw, -5.0),
    "reversal": _reversal,
    "tremor": _tremor,
    "re-grip": _re_grip,
    "falling force": _falling_force,
    "tap": _tap,
    "lift-off": _lift_off,
    "rest": _rest,
    "re-grip in a slide": _re_grip_in_a_slide,
}

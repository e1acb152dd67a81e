"""Random trials on the simulated skin whose truth is known. Detectors are tuned and scored on them.

Every trial is drawn from its kind and seed alone: friction, rubber, force, motion and the jitter of
the stage come from stated ranges (all assumed). A trial holds noise-free volts at the rate of the
data acquisition and begins with quiet. Noise, mains and unequal gains are added separately, so that
one contact can be recorded through several front ends.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rig.core.cache import Cache, NoCache
from rig.core.settings import fingerprint
from rig.physics.contact.settings import ContactSettings, Cylinder, FrictionSettings, Object, Plate
from rig.physics.contact.stepper import ConvergenceError
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.trials import RollSettings, Script, SkinTrial, SlideSettings, follow

Floats = NDArray[np.float64]

Kind = Literal["slide", "roll", "hold", "tap"]
"""Kinds of motion."""
Label = Literal["slip", "roll", "lift-off", "hold", "tap", "slip in a roll"]
"""Labels of trials, by their truth."""
LABELS: tuple[Label, ...] = get_args(Label)

_FORMAT = 2
_RAMP_S = 0.05
_SETTLE_S = 0.1
_AFTER_GROSS_S = 0.06
_REDRAWS = 20


@dataclass(frozen=True)
class LabelledTrial:
    """A simulated trial and its truth. Times are in s from its first sample, NaN where it did not
    happen."""

    kind: Kind
    """Kind of motion."""
    seed: int
    """Seed from which it was drawn."""
    label: Label
    """Label, from the truth of the contact."""
    rate_Hz: float
    """Sampling rate, in Hz."""
    volts: Floats
    """Signals v_1 and v_2 without noise, in V, (n, 2)."""
    force_N: Floats
    """Forces F_n and F_t, in N, (n, 2)."""
    motion_s: float
    """Start of the slide, roll or tap."""
    node_slip_s: float
    """Slip of the first node of the ridge that is read."""
    ridge_slip_s: float
    """Slip of the whole ridge."""
    gross_slip_s: float
    """Slip of the whole contact."""
    lift_off_s: float
    """Time at which the ridge leaves the object."""
    traits: dict[str, float]
    """Numbers that were drawn, by name and unit."""


def through_front_end(
    trial: LabelledTrial, front_end: StripFrontEndSettings, hearing: int = 0
) -> tuple[Floats, dict[str, float]]:
    """Returns the volts (n, 2) that a bench would record, and what was added to them, by name and
    unit.

    `hearing` numbers the front ends. Each number draws new values from the trial's kind and seed.
    """
    chance = np.random.default_rng([get_args(Kind).index(trial.kind), trial.seed, 1, hearing])
    noise = front_end.noise_mV.draw(chance)
    mains = front_end.mains_mV.draw(chance)
    mismatch = front_end.gain_mismatch.draw(chance)
    size = len(trial.volts)
    phase = 2 * np.pi * front_end.mains_Hz * np.arange(size) / trial.rate_Hz
    phases = chance.uniform(0, 2 * np.pi) + np.array([0.0, chance.uniform(-0.3, 0.3)])
    volts = trial.volts * np.array([1 + mismatch / 2, 1 - mismatch / 2])
    volts = volts + 1e-3 * mains * np.sin(phase[:, None] + phases)
    volts = volts + 1e-3 * noise * chance.standard_normal((size, 2))
    return volts, {"noise_mV": noise, "mains_mV": mains, "gain_mismatch": mismatch}


def labelled_trial(
    skin: CondensedSkin,
    kind: Kind,
    seed: int,
    population: PopulationSettings | None = None,
    cache: Cache | None = None,
) -> LabelledTrial:
    """Returns the trial of a kind and seed, from the cache if it is there.

    If a step of the contact has no solution the trial is drawn again. Raises ConvergenceError after
    the 20th draw.
    """
    population = PopulationSettings() if population is None else population
    cache = NoCache() if cache is None else cache
    key = f"labelled-trial-{_FORMAT}-{kind}-{seed}-{fingerprint(population)}"
    stored = cache.get(key)
    trial = None if stored is None else _unpack(stored, kind, seed)
    if trial is None:
        trial = _perform(skin, kind, seed, population)
        cache.put(key, _pack(trial))
    return trial


def _perform(
    skin: CondensedSkin, kind: Kind, seed: int, population: PopulationSettings
) -> LabelledTrial:
    for redraw in range(_REDRAWS):
        chance = np.random.default_rng([get_args(Kind).index(kind), seed, 0, redraw])
        try:
            return _KINDS[kind](_TrialDraw(skin, kind, seed, population, chance))
        except ConvergenceError as error:
            last = error
    raise last


class _TrialDraw:
    """Draws what all kinds of trials have in common, and turns a motion into a trial."""

    def __init__(
        self,
        skin: CondensedSkin,
        kind: Kind,
        seed: int,
        population: PopulationSettings,
        chance: np.random.Generator,
    ):
        self.skin, self.kind, self.seed = skin, kind, seed
        self.population, self.chance = population, chance
        self.traits: dict[str, float] = {}
        static = self.draw("static_coefficient")
        ratio = self.draw("friction_ratio")
        self.contact = ContactSettings(
            friction=FrictionSettings(
                static_coefficient=static,
                kinetic_coefficient=static * ratio,
                weakening_distance_um=self.draw("weakening_distance_um"),
            ),
            relaxation_time_ms=self.draw("relaxation_time_ms"),
        )
        self.force_N = self.draw("normal_force_N")
        self.loading_s, self.rest_s = self.draw("loading_s"), self.draw("rest_s")
        jitters = chance.random() < 0.5
        self.jitter_mm = 1e-3 * self.draw("jitter_um") * jitters
        self.jitter_Hz = self.draw("jitter_Hz")
        self.traits["jitter_um"] *= jitters

    def draw(self, name: str) -> float:
        """Returns a number of the population and records it among the traits."""
        within: Range = getattr(self.population, name)
        self.traits[name] = within.draw(self.chance)
        return self.traits[name]

    def draw_sign(self, name: str) -> float:
        """Returns +1 or -1 and records it among the traits."""
        self.traits[name] = float(self.chance.choice((-1.0, 1.0)))
        return self.traits[name]

    @property
    def motion_s(self) -> float:
        """Start of the motion, in s from first touch."""
        return self.loading_s + self.rest_s

    def times(self, duration_s: float) -> Floats:
        """Returns the end of every step, from first touch to `duration_s` after the start of the
        motion."""
        step = self.contact.step_us * 1e-6
        times: Floats = step * np.arange(1.0, 1 + round((self.motion_s + duration_s) / step))
        return times

    def pressed(self, time_s: Floats) -> Floats:
        """Returns the normal force: a raised cosine, then constant."""
        share = np.clip(time_s / self.loading_s, 0, 1)
        force: Floats = self.force_N * (1 - np.cos(np.pi * share)) / 2
        return force

    def follow(
        self,
        force_N: Floats,
        x_mm: Floats,
        angle_rad: Floats | None = None,
        *,
        body: Object | None = None,
        start_x_mm: float = 0.0,
    ) -> SkinTrial:
        """Simulates a motion with the jitter of the stage."""
        body = Plate() if body is None else body
        times = self.contact.step_us * 1e-6 * np.arange(1.0, 1 + force_N.size)
        shaken = x_mm + self.jitter_mm * np.sin(2 * np.pi * self.jitter_Hz * times)
        angle = np.zeros_like(force_N) if angle_rad is None else angle_rad
        settings = (SlideSettings if isinstance(body, Plate) else RollSettings)(
            contact=self.contact, body=body, ridge=self.population.ridge
        )
        script = Script(force_N, shaken, angle, motion_s=self.motion_s, start_x_mm=start_x_mm)
        return follow(self.skin, settings, script)

    def finish(self, trial: SkinTrial, label: Label, end_s: float = math.inf) -> LabelledTrial:
        """Returns the labelled trial up to `end_s` after first touch."""
        at, truth = self.population.ridge - 1, trial.truth
        rate = SlideSettings().sample.rate_Hz
        kept = trial.sample_time_s <= end_s
        rows = np.searchsorted(trial.time_s, trial.sample_time_s[kept] - 1e-9)
        quiet = round(self.population.quiet_s * rate)
        forces = np.column_stack([trial.block.normal_force_N, trial.block.tangential_force_N])
        return LabelledTrial(
            kind=self.kind,
            seed=self.seed,
            label=label,
            rate_Hz=rate,
            volts=_rounded(np.vstack([np.zeros((quiet, 2)), trial.sampled[kept]])),
            force_N=_rounded(np.vstack([np.zeros((quiet, 2)), forces[rows]])),
            motion_s=quiet / rate + self.motion_s,
            node_slip_s=quiet / rate + float(truth.first_slip_s[at]),
            ridge_slip_s=quiet / rate + float(truth.whole_slip_s[at]),
            gross_slip_s=quiet / rate + truth.gross_slip_s,
            lift_off_s=quiet / rate + float(truth.lift_off_s[at]),
            traits=self.traits,
        )


def _rounded(values: Floats) -> Floats:
    """Rounds to the precision of the cache, so that a trial is the same with and without it."""
    return values.astype(np.float32).astype(np.float64)


def _to_gross_slip(drawing: _TrialDraw) -> tuple[SkinTrial, float, float]:
    """Returns a slide until everything slips, its velocity in mm/s, and the time of gross slip from
    first touch."""
    speed = drawing.draw("speed_mm_s")
    velocity = speed * drawing.draw_sign("direction")
    softness = 1.7 / drawing.population.skin.youngs_modulus_MPa
    reach_mm = 0.03 + 0.09 * softness * drawing.force_N * drawing.traits["static_coefficient"]
    for _ in range(3):
        time = drawing.times(reach_mm / speed + _RAMP_S + _AFTER_GROSS_S)
        since = time - drawing.motion_s
        inside = np.clip(since, 0.0, _RAMP_S)
        x = velocity * (inside**2 / (2 * _RAMP_S) + np.clip(since - _RAMP_S, 0.0, None))
        trial = drawing.follow(drawing.pressed(time), x)
        if math.isfinite(trial.truth.gross_slip_s):
            return trial, velocity, trial.truth.gross_slip_s
        reach_mm *= 2
    raise ConvergenceError(f"no gross slip within {reach_mm / 2:.2f} mm of a slide")


def _slide(drawing: _TrialDraw) -> LabelledTrial:
    trial, _, gross = _to_gross_slip(drawing)
    return drawing.finish(trial, "slip", gross + _AFTER_GROSS_S)


def _hold(drawing: _TrialDraw) -> LabelledTrial:
    """Simulates a slide that stops short. If the ridge slips as a whole nevertheless, it is
    labelled a slip."""
    whole, velocity, gross = _to_gross_slip(drawing)
    row = int(np.searchsorted(whole.time_s, gross))
    way_mm = drawing.draw("held_share") * abs(float(whole.block.position_mm[row]))
    speed = abs(velocity)
    acceleration = speed / _RAMP_S
    peak = min(speed, math.sqrt(acceleration * way_mm))
    rise_s, cruise_s = peak / acceleration, way_mm / peak - peak / acceleration
    time = drawing.times(2 * rise_s + cruise_s + drawing.population.held_s)
    since = time - drawing.motion_s
    corners = np.cumsum([0.0, rise_s, cruise_s, rise_s])
    pace = np.interp(since, corners, [0.0, peak, peak, 0.0])
    x = math.copysign(drawing.contact.step_us * 1e-6, velocity) * np.cumsum(pace)
    trial = drawing.follow(drawing.pressed(time), x)
    slipped = math.isfinite(trial.truth.whole_slip_s[drawing.population.ridge - 1])
    return drawing.finish(trial, "slip" if slipped else "hold")


def _roll(drawing: _TrialDraw) -> LabelledTrial:
    duration = drawing.draw("roll_s")
    body = Cylinder(radius_mm=drawing.draw("radius_mm"))
    angle = math.radians(drawing.draw("angle_deg")) * drawing.draw_sign("direction")
    start = drawing.draw("start_x_mm")
    time = drawing.times(duration + _SETTLE_S)
    share = np.clip((time - drawing.motion_s) / duration, 0.0, 1.0)
    turned = angle * (1 - np.cos(np.pi * share)) / 2
    x = start + body.radius_mm * turned
    trial = drawing.follow(drawing.pressed(time), x, turned, body=body, start_x_mm=start)
    at = drawing.population.ridge - 1
    label: Label = "roll"
    if math.isfinite(trial.truth.lift_off_s[at]):
        label = "lift-off"
    elif math.isfinite(trial.truth.whole_slip_s[at]):
        label = "slip in a roll"
    return drawing.finish(trial, label)


def _tap(drawing: _TrialDraw) -> LabelledTrial:
    """Simulates a knock at the finger while an object rests on it."""
    duration = drawing.draw("tap_s")
    rise_N = drawing.draw("tap_share") * drawing.force_N
    sideways_mm = 1e-3 * drawing.draw("tap_um") * drawing.draw_sign("direction")
    time = drawing.times(duration + 2 * _SETTLE_S)
    pulse = np.sin(np.pi * np.clip((time - drawing.motion_s) / duration, 0.0, 1.0))
    trial = drawing.follow(drawing.pressed(time) + rise_N * pulse, sideways_mm * pulse)
    slipped = math.isfinite(trial.truth.whole_slip_s[drawing.population.ridge - 1])
    return drawing.finish(trial, "slip" if slipped else "tap")


_KINDS: dict[Kind, Callable[[_TrialDraw], LabelledTrial]] = {
    "slide": _slide,
    "roll": _roll,
    "hold": _hold,
    "tap": _tap,
}

_TIMES = ("rate_Hz", "motion_s", "node_slip_s", "ridge_slip_s", "gross_slip_s", "lift_off_s")


def _pack(trial: LabelledTrial) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        volts=trial.volts.astype(np.float32),
        force_N=trial.force_N.astype(np.float32),
        times=np.array([getattr(trial, name) for name in _TIMES]),
        label=np.array(trial.label),
        names=np.array(list(trial.traits)),
        traits=np.array(list(trial.traits.values())),
    )
    return buffer.getvalue()


def _unpack(content: bytes, kind: Kind, seed: int) -> LabelledTrial | None:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return LabelledTrial(
                kind=kind,
                seed=seed,
                label=next(label for label in LABELS if label == str(stored["label"])),
                volts=stored["volts"].astype(np.float64),
                force_N=stored["force_N"].astype(np.float64),
                traits=dict(zip(stored["names"].tolist(), stored["traits"].tolist(), strict=True)),
                **dict(zip(_TIMES, stored["times"].tolist(), strict=True)),
            )
    except (OSError, ValueError, KeyError, EOFError, StopIteration, zipfile.BadZipFile):
        return None

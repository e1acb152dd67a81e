"""Random trials on the simulated skin whose truth is known. Detectors are tuned and scored on them.

Every trial is drawn from its kind and seed alone: friction, rubber, force, motion and the jitter of
the stage come from stated ranges (all assumed). A trial holds noise-free volts at the rate of the
data acquisition and begins with quiet. What amplifiers and converter add is added separately, so
that one contact can be recorded through several front ends (`rig.evaluation.front_ends`).
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
from rig.physics.contact.truth import WholeSlips, slips_whole
from rig.physics.population import PopulationSettings, Range, placed_mm
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import RollSettings, Script, SkinTrial, SlideSettings, follow

Floats = NDArray[np.float64]

Kind = Literal[
    "slide", "roll", "hold", "tap", "again", "reversal", "tremor", "falling force", "re-grip",
    "lift-off",
]  # fmt: skip
"""Kinds of motion."""
KINDS: tuple[Kind, ...] = get_args(Kind)
USUAL_KINDS: tuple[Kind, ...] = ("slide", "roll", "hold", "tap")
"""Kinds that are scored where none are named (decision 0048)."""
Label = Literal["slip", "roll", "lift-off", "hold", "tap", "slip in a roll"]
"""Labels of trials, by their truth."""
LABELS: tuple[Label, ...] = get_args(Label)

_FORMAT = 3
_TICK_RISE_S = 0.003
_SETTLE_S = 0.1
LIFTS_WITHIN_S = 0.1
"""A slip of the whole ridge less than this before its lift-off is part of it."""
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
    slips_s: Floats
    """Begin and end of every slip of the whole ridge, the first included, (k, 2)."""
    traits: dict[str, float]
    """Numbers that were drawn, by name and unit."""


def labelled_trial(
    skin: CondensedSkin,
    kind: Kind,
    seed: int,
    population: PopulationSettings | None = None,
    cache: Cache | None = None,
) -> LabelledTrial:
    """Return the trial of a kind and seed, from the cache if it is there.

    If a step of the contact has no solution the trial is drawn again. Raises ConvergenceError after
    the 20th draw.
    """
    population = PopulationSettings() if population is None else population
    cache = NoCache() if cache is None else cache
    key = f"labelled-trial-{_FORMAT}-{kind}-{seed}-{fingerprint(population)}"
    stored = cache.get(key)
    trial = None if stored is None else _unpack(stored, kind, seed)
    if trial is None:
        trial = _perform(skin, kind, seed, population, cache)
        cache.put(key, _pack(trial))
    return trial


def _perform(
    skin: CondensedSkin, kind: Kind, seed: int, population: PopulationSettings, cache: Cache
) -> LabelledTrial:
    for redraw in range(_REDRAWS):
        chance = np.random.default_rng([KINDS.index(kind), seed, 0, redraw])
        try:
            drawing = _TrialDraw(skin, kind, seed, population, chance)
            if population.drawn_skin:
                drawing.draw_skin(cache)
            return _KINDS[kind](drawing)
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
        # Draws of their own, so that what was drawn above does not depend on them.
        self.further = np.random.default_rng([KINDS.index(kind), seed, 2])
        self.tick_Hz = self.draw_further("tick_Hz")
        self.tick_share = self.draw_further("tick_share")
        self.ramp_s = self.draw_further("ramp_s")

    def draw(self, name: str) -> float:
        """Return a number of the population and record it among the traits."""
        within: Range = getattr(self.population, name)
        self.traits[name] = within.draw(self.chance)
        return self.traits[name]

    def draw_further(self, name: str) -> float:
        """Return a number that was added to the population later, and record it."""
        within: Range = getattr(self.population, name)
        self.traits[name] = within.draw(self.further)
        return self.traits[name]

    def draw_skin(self, cache: Cache) -> None:
        """Draw modulus and place of the strips of the skin."""
        youngs_MPa = self.draw_further("youngs_modulus_MPa")
        offset_mm = placed_mm(self.draw_further("strip_offset_mm"))
        self.traits["strip_offset_mm"] = offset_mm
        body = self.population.skin.model_dump() | {"youngs_modulus_MPa": youngs_MPa}
        body["strips"]["offset_mm"] = offset_mm
        self.skin = build_skin(SkinSettings.model_validate(body), cache)

    def draw_sign(self, name: str) -> float:
        """Return +1 or -1 and record it among the traits."""
        self.traits[name] = float(self.chance.choice((-1.0, 1.0)))
        return self.traits[name]

    @property
    def motion_s(self) -> float:
        """Start of the motion, in s from first touch."""
        return self.loading_s + self.rest_s

    def times(self, duration_s: float) -> Floats:
        """Return the end of every step, from first touch to `duration_s` after the start of the
        motion."""
        step = self.contact.step_us * 1e-6
        times: Floats = step * np.arange(1.0, 1 + round((self.motion_s + duration_s) / step))
        return times

    def pressed(self, time_s: Floats) -> Floats:
        """Return the normal force: a raised cosine, then constant."""
        share = np.clip(time_s / self.loading_s, 0, 1)
        force: Floats = self.force_N * (1 - np.cos(np.pi * share)) / 2
        return force

    def ticks(self, time_s: Floats) -> Floats:
        """Return the relative error of the normal force: at each tick of the servo it takes
        another value, within 3 ms and not beyond the next tick."""
        if self.tick_share == 0:
            return np.zeros_like(time_s)
        period_s = 1 / self.tick_Hz
        count = int(time_s[-1] / period_s) + 2
        errors, error = np.zeros(count), 0.0
        for tick, step in enumerate(self.further.standard_normal(count)):
            # It forgets half of its error in a few ticks, as a servo that controls does.
            error = 0.8 * error + self.tick_share * step
            errors[tick] = error
        begins = period_s * np.arange(count)
        rises = begins + min(_TICK_RISE_S, 0.9 * period_s)
        corners = np.column_stack([begins, rises]).ravel()
        levels = np.column_stack([np.concatenate([[0.0], errors[:-1]]), errors]).ravel()
        pressed = np.clip(time_s / self.loading_s, 0, 1) ** 2
        wander: Floats = pressed * np.interp(time_s, corners, levels)
        return wander

    def follow(
        self,
        force_N: Floats,
        x_mm: Floats,
        angle_rad: Floats | None = None,
        *,
        body: Object | None = None,
        start_x_mm: float = 0.0,
    ) -> SkinTrial:
        """Simulate a motion with the jitter of the stage."""
        body = Plate() if body is None else body
        times = self.contact.step_us * 1e-6 * np.arange(1.0, 1 + force_N.size)
        shaken = x_mm + self.jitter_mm * np.sin(2 * np.pi * self.jitter_Hz * times)
        angle = np.zeros_like(force_N) if angle_rad is None else angle_rad
        force_N = force_N * (1 + self.ticks(times))
        settings = (SlideSettings if isinstance(body, Plate) else RollSettings)(
            contact=self.contact, body=body, ridge=self.population.ridge
        )
        script = Script(force_N, shaken, angle, motion_s=self.motion_s, start_x_mm=start_x_mm)
        return follow(self.skin, settings, script)

    def finish(
        self, trial: SkinTrial, label: Label | None = None, end_s: float = math.inf
    ) -> LabelledTrial:
        """Return the trial up to `end_s` after first touch, labelled by its truth unless a label
        is given. What happens after its end is not in its truth."""
        at, truth = self.population.ridge - 1, trial.truth
        rate = SlideSettings().sample.rate_Hz
        kept = trial.sample_time_s <= end_s
        rows = np.searchsorted(trial.time_s, trial.sample_time_s[kept] - 1e-9)
        quiet = round(self.population.quiet_s * rate)
        forces = np.column_stack([trial.block.normal_force_N, trial.block.tangential_force_N])
        record_s = (quiet + int(kept.sum())) / rate

        def seen_s(after_touch_s: float) -> float:
            at_s = quiet / rate + float(after_touch_s)
            return at_s if at_s <= record_s else math.nan

        whole_s, lift_s = seen_s(truth.whole_slip_s[at]), seen_s(truth.lift_off_s[at])
        if label is None:
            label = _label_of(self.kind, whole_s, lift_s)
        return LabelledTrial(
            kind=self.kind,
            seed=self.seed,
            label=label,
            rate_Hz=rate,
            volts=_rounded(np.vstack([np.zeros((quiet, 2)), trial.sampled[kept]])),
            force_N=_rounded(np.vstack([np.zeros((quiet, 2)), forces[rows]])),
            motion_s=quiet / rate + self.motion_s,
            node_slip_s=seen_s(truth.first_slip_s[at]),
            ridge_slip_s=whole_s,
            gross_slip_s=seen_s(truth.gross_slip_s),
            lift_off_s=lift_s,
            slips_s=self._slips_s(trial, quiet / rate, record_s),
            traits=self.traits,
        )

    def _slips_s(self, trial: SkinTrial, quiet_s: float, record_s: float) -> Floats:
        """Return begin and end of every slip of the whole ridge since the motion began."""
        step_us = round(self.contact.step_us)
        first = int(np.searchsorted(trial.time_s, trial.motion_s - 1e-9))
        slips = WholeSlips()
        status = trial.block.status[first:]
        slips.add(
            (first + 1) * step_us, step_us,
            slips_whole(status, self.skin.ridge, self.population.ridge - 1),
        )  # fmt: skip
        begins = quiet_s + 1e-6 * np.array(slips.begins_us, dtype=np.float64)
        ends = np.full(begins.size, record_s)
        ends[: len(slips.ends_us)] = quiet_s + 1e-6 * np.array(slips.ends_us, dtype=np.float64)
        inside = begins <= record_s
        pairs: Floats = np.column_stack([begins, np.minimum(ends, record_s)])[inside]
        return pairs


def _label_of(kind: Kind, whole_s: float, lift_s: float) -> Label:
    """Return the label of a trial from its truth. A ridge that is let go slips before it leaves
    the object: a slip less than 0.1 s before it is part of the lift-off."""
    lifted, slipped = math.isfinite(lift_s), math.isfinite(whole_s)
    if kind == "roll":
        return "lift-off" if lifted else "slip in a roll" if slipped else "roll"
    if slipped and not (lifted and whole_s >= lift_s - LIFTS_WITHIN_S):
        return "slip"
    if lifted:
        return "lift-off"
    return "tap" if kind == "tap" else "hold"


def _rounded(values: Floats) -> Floats:
    """Round to the precision of the cache, so that a trial is the same with and without it."""
    return values.astype(np.float32).astype(np.float64)


def _to_gross_slip(drawing: _TrialDraw) -> tuple[SkinTrial, float, float]:
    """Return a slide until everything slips, its velocity in mm/s, and the time of gross slip from
    first touch."""
    speed = drawing.draw("speed_mm_s")
    velocity = speed * drawing.draw_sign("direction")
    softness = 1.7 / drawing.skin.settings.youngs_modulus_MPa
    reach_mm = 0.03 + 0.09 * softness * drawing.force_N * drawing.traits["static_coefficient"]
    for _ in range(3):
        time = drawing.times(reach_mm / speed + drawing.ramp_s + _AFTER_GROSS_S)
        since = time - drawing.motion_s
        inside = np.clip(since, 0.0, drawing.ramp_s)
        x = velocity * (
            inside**2 / (2 * drawing.ramp_s) + np.clip(since - drawing.ramp_s, 0.0, None)
        )
        trial = drawing.follow(drawing.pressed(time), x)
        if math.isfinite(trial.truth.gross_slip_s):
            return trial, velocity, trial.truth.gross_slip_s
        reach_mm *= 2
    raise ConvergenceError(f"no gross slip within {reach_mm / 2:.2f} mm of a slide")


def _slide(drawing: _TrialDraw) -> LabelledTrial:
    trial, _, gross = _to_gross_slip(drawing)
    return drawing.finish(trial, "slip", gross + _AFTER_GROSS_S)


def _stroke(speed_mm_s: float, way_mm: float, ramp_s: float) -> tuple[Floats, Floats]:
    """Return times and speeds of a stroke that begins and ends at rest, and reaches its speed
    within `ramp_s`."""
    acceleration = speed_mm_s / ramp_s
    peak = min(speed_mm_s, math.sqrt(acceleration * way_mm))
    rise_s, cruise_s = peak / acceleration, way_mm / peak - peak / acceleration
    return np.cumsum([0.0, rise_s, cruise_s, rise_s]), np.array([0.0, peak, peak, 0.0])


def _strokes(
    drawing: _TrialDraw, ways_mm: list[float], speed_mm_s: float, rest_s: float, after_s: float
) -> tuple[Floats, Floats]:
    """Return times and positions of strokes, forward and backward, with a rest after each and a
    longer one after the last."""
    corners, speeds, begin_s = [np.zeros(1)], [np.zeros(1)], 1e-9
    for way_mm in ways_mm:
        times, pace = _stroke(speed_mm_s, abs(way_mm), drawing.ramp_s)
        corners.append(begin_s + times)
        speeds.append(math.copysign(1.0, way_mm) * pace)
        begin_s += float(times[-1]) + rest_s + 1e-9
    time = drawing.times(begin_s + after_s)
    pace = np.interp(time - drawing.motion_s, np.concatenate(corners), np.concatenate(speeds))
    return time, drawing.contact.step_us * 1e-6 * np.cumsum(pace)


def _whole_way(drawing: _TrialDraw) -> tuple[float, float]:
    """Return the way of a slide to the slip of the whole ridge, with its sign, in mm, and the
    speed of the slide in mm/s."""
    slide, velocity, gross = _to_gross_slip(drawing)
    whole = float(slide.truth.whole_slip_s[drawing.population.ridge - 1])
    row = int(np.searchsorted(slide.time_s, whole if math.isfinite(whole) else gross))
    return float(slide.block.position_mm[row]), abs(velocity)


def _again(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate slides with stops between them: the ridge sticks, and slips again."""
    slide, velocity, gross = _to_gross_slip(drawing)
    row = int(np.searchsorted(slide.time_s, gross))
    way_mm = 1.15 * float(slide.block.position_mm[row])
    back = drawing.further.random() < 0.5
    ways = [way_mm, -2 * way_mm, 2 * way_mm] if back else [way_mm, 0.5 * way_mm, 0.5 * way_mm]
    rest_s = drawing.further.uniform(0.05, 0.3)
    time, x = _strokes(drawing, ways, abs(velocity), rest_s, _SETTLE_S)
    return drawing.finish(drawing.follow(drawing.pressed(time), x))


def _reversal(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate shear to and fro below the slip of the ridge."""
    way_mm, speed = _whole_way(drawing)
    sheared_mm = drawing.draw_further("sheared_share") * way_mm
    turns = int(drawing.draw_further("reversals"))
    ways = [sheared_mm] + [2 * sheared_mm * (-1) ** (turn + 1) for turn in range(turns)]
    time, x = _strokes(drawing, ways, speed, 0.0, 2 * _SETTLE_S)
    return drawing.finish(drawing.follow(drawing.pressed(time), x))


def _tremor(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate a hold under shear in which the object trembles."""
    way_mm, speed = _whole_way(drawing)
    sheared_mm = drawing.draw_further("sheared_share") * way_mm
    rate_Hz, share = drawing.draw_further("tremor_Hz"), drawing.draw_further("tremor_share")
    time, x = _strokes(drawing, [sheared_mm], speed, 0.1, 1.0)
    since = np.clip(time - time[-1] + 1.0, 0.0, None)
    shaken = share * way_mm * np.sin(2 * np.pi * rate_Hz * since) * np.clip(since / 0.1, 0, 1)
    return drawing.finish(drawing.follow(drawing.pressed(time), x + shaken))


def _loaded(drawing: _TrialDraw, share: float, after_s: float) -> tuple[Floats, Floats, Floats]:
    """Return times, positions, and the time since 0.2 s after a shear has come to rest."""
    way_mm, speed = _whole_way(drawing)
    time, x = _strokes(drawing, [share * way_mm], speed, 0.2, after_s)
    return time, x, np.clip(time - time[-1] + after_s, 0.0, None)


def _falling_force(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate a grip that loosens under a load until the load slips or is hardly held."""
    share, fall_s = drawing.draw_further("loaded_share"), drawing.draw_further("fall_s")
    time, x, since = _loaded(drawing, share, fall_s + _SETTLE_S)
    falls = 1 - (1 - 0.5 * share) * np.clip(since / fall_s, 0.0, 1.0)
    return drawing.finish(drawing.follow(drawing.pressed(time) * falls, x))


def _re_grip(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate a firmer grip under a load."""
    share, rise_s = drawing.draw_further("loaded_share"), drawing.draw_further("grip_s")
    rise = drawing.draw_further("grip_share")
    time, x, since = _loaded(drawing, share, rise_s + 0.4)
    return drawing.finish(
        drawing.follow(drawing.pressed(time) * (1 + rise * np.clip(since / rise_s, 0.0, 1.0)), x)
    )


def _lift_off(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate an object that is let go, with hardly any load."""
    fall_s = drawing.draw_further("fall_s")
    time, x, since = _loaded(drawing, drawing.further.uniform(0.01, 0.15), fall_s + _SETTLE_S)
    falls = 1 - 0.98 * np.clip(since / fall_s, 0.0, 1.0)
    return drawing.finish(drawing.follow(drawing.pressed(time) * falls, x))


def _hold(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate a slide that stops short. If the ridge slips as a whole nevertheless, it is
    labelled a slip."""
    whole, velocity, gross = _to_gross_slip(drawing)
    row = int(np.searchsorted(whole.time_s, gross))
    way_mm = drawing.draw("held_share") * abs(float(whole.block.position_mm[row]))
    times, pace = _stroke(abs(velocity), way_mm, drawing.ramp_s)
    time = drawing.times(float(times[-1]) + drawing.population.held_s)
    speed = np.interp(time - drawing.motion_s, times, pace)
    x = math.copysign(drawing.contact.step_us * 1e-6, velocity) * np.cumsum(speed)
    return drawing.finish(drawing.follow(drawing.pressed(time), x))


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
    return drawing.finish(trial)


def _tap(drawing: _TrialDraw) -> LabelledTrial:
    """Simulate a knock at the finger while an object rests on it."""
    duration = drawing.draw("tap_s")
    rise_N = drawing.draw("tap_share") * drawing.force_N
    sideways_mm = 1e-3 * drawing.draw("tap_um") * drawing.draw_sign("direction")
    time = drawing.times(duration + 2 * _SETTLE_S)
    pulse = np.sin(np.pi * np.clip((time - drawing.motion_s) / duration, 0.0, 1.0))
    trial = drawing.follow(drawing.pressed(time) + rise_N * pulse, sideways_mm * pulse)
    return drawing.finish(trial)


_KINDS: dict[Kind, Callable[[_TrialDraw], LabelledTrial]] = {
    "slide": _slide,
    "roll": _roll,
    "hold": _hold,
    "tap": _tap,
    "again": _again,
    "reversal": _reversal,
    "tremor": _tremor,
    "falling force": _falling_force,
    "re-grip": _re_grip,
    "lift-off": _lift_off,
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
        slips_s=trial.slips_s,
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
                slips_s=stored["slips_s"],
                traits=dict(zip(stored["names"].tolist(), stored["traits"].tolist(), strict=True)),
                **dict(zip(_TIMES, stored["times"].tolist(), strict=True)),
            )
    except (OSError, ValueError, KeyError, EOFError, StopIteration, zipfile.BadZipFile):
        return None

"""Scripted trials on the simulated skin: the paper's slide (4.1) and roll (5), from settings to
arrays.

A trial presses an object onto the skin along a raised cosine, lets it rest, and then slides or
rolls it. The result contains forces, statuses, volts at the step rate, and the samples of a 1 kHz
data acquisition behind its analogue filter. Everything here is simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.core.settings import Settings
from rig.physics.contact.settings import ContactSettings, Cylinder, Object, Plate
from rig.physics.contact.slices import LARGEST_FORCE_N, make_stepper
from rig.physics.contact.stepper import ContactBlock
from rig.physics.contact.truth import SlipTruth, SlipWatch
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.transducer import TransducerChain, TransducerSettings

Floats = NDArray[np.float64]


class PressSettings(Settings):
    """Pressing of the object before the motion (assumed)."""

    normal_force_N: float = Field(4.0, gt=0)
    """Normal force F_n (paper 2.2: 4 N brings nine ridges into contact)."""
    loading_s: float = Field(0.3, gt=0)
    """Duration of the raised cosine from 0 to F_n."""
    rest_s: float = Field(0.15, ge=0)
    """Rest before the motion."""


class SampleSettings(Settings):
    """Data acquisition of the skin: an analogue Butterworth filter, then sampling at a low rate."""

    rate_Hz: float = Field(1000.0, gt=0)
    """Sampling rate (paper 4.1)."""
    filter_Hz: float = Field(400.0, gt=0)
    """-3 dB frequency of the filter (assumed)."""
    filter_order: int = Field(4, ge=1, le=8)
    """Order of the filter."""


class SlideSettings(Settings):
    """A slide of the plate or another object at constant normal force."""

    press: PressSettings = PressSettings()
    """Pressing before the slide."""
    contact: ContactSettings = ContactSettings()
    """Friction and time step of the contact."""
    transducer: TransducerSettings = TransducerSettings()
    """Films and amplifiers of the strips."""
    sample: SampleSettings = SampleSettings()
    """Data acquisition of the strips."""
    body: Object = Plate()
    """The object that slides."""
    start_x_mm: float = 0.0
    """Position x of the object at first touch."""
    speed_mm_s: float = Field(0.5, ge=0)
    """Speed after the ramp, towards +x."""
    ramp_s: float = Field(0.05, ge=0)
    """Duration of the linear ramp of the speed."""
    slide_s: float = Field(0.4, gt=0)
    """Duration of the motion."""
    ridge: int = Field(3, ge=1)
    """Ridge whose strips are read; 1 is the leftmost."""


class RollSettings(Settings):
    """A roll of a cylinder or a head at constant normal force."""

    press: PressSettings = PressSettings()
    """Pressing before the roll."""
    contact: ContactSettings = ContactSettings()
    """Friction and time step of the contact."""
    transducer: TransducerSettings = TransducerSettings()
    """Films and amplifiers of the strips."""
    sample: SampleSettings = SampleSettings()
    """Data acquisition of the strips."""
    body: Object = Cylinder()
    """The object that rolls."""
    start_x_mm: float = -5.0
    """Position x of the middle of the contact before the roll. -5.0 ends centred near ridge 3, -6.5
    before it."""
    angle_deg: float = 3.5
    """Angle of the roll (paper 5), along a raised cosine. A positive angle moves the contact
    towards +x."""
    roll_s: float = Field(0.4, gt=0)
    """Duration of the roll."""
    settle_s: float = Field(0.1, ge=0)
    """Rest after the roll."""
    axis_offset_mm: float = 0.0
    """Distance of the rotary axis from its position for pure rolling. It shears the skin by offset
    times angle."""
    ridge: int = Field(3, ge=1)
    """Ridge whose strips are read; 1 is the leftmost."""


@dataclass(frozen=True)
class SkinTrial:
    """A simulated trial: rows at the step rate, and samples at the rate of the data acquisition."""

    time_s: Floats
    """End of each step, (k,)."""
    motion_s: float
    """Start of the slide or roll."""
    block: ContactBlock
    """Forces, statuses and stresses, (k, ...)."""
    truth: SlipTruth
    """Times of slip, judged from the start of the motion."""
    volts: Floats
    """Signals of S1 and S2 at the step rate, unfiltered, (k, 2)."""
    filtered: Floats
    """Signals of S1 and S2 behind the analogue filter, (k, 2)."""
    sample_time_s: Floats
    """Sampling instants, (n,)."""
    sampled: Floats
    """Signals v_1 and v_2 as sampled, (n, 2)."""

    @property
    def v_d(self) -> Floats:
        """Differential signal v_1 - v_2 of the paper as sampled, in V, (n,)."""
        difference: Floats = self.sampled[:, 0] - self.sampled[:, 1]
        return difference

    @property
    def filtered_v_d(self) -> Floats:
        """Signal v_1 - v_2 behind the analogue filter at the step rate, in V, (k,)."""
        difference: Floats = self.filtered[:, 0] - self.filtered[:, 1]
        return difference


def slide(skin: CondensedSkin, settings: SlideSettings, *, keep_forces: bool = False) -> SkinTrial:
    """Simulate pressing, rest and slide. Raises ConvergenceError if a step has no solution."""

    def travel(t: Floats) -> tuple[Floats, Floats]:
        ramp = settings.ramp_s
        inside = np.clip(t, 0.0, ramp)
        ramped = inside**2 / (2 * ramp) if ramp > 0 else np.zeros_like(t)
        x = settings.start_x_mm + settings.speed_mm_s * (ramped + np.clip(t - ramp, 0.0, None))
        return x, np.zeros_like(t)

    return _run(skin, settings, travel, settings.slide_s, settings.start_x_mm, keep_forces)


def roll(skin: CondensedSkin, settings: RollSettings, *, keep_forces: bool = False) -> SkinTrial:
    """Simulate pressing, rest, roll and rest.

    Raises ValueError for a plate, which cannot roll, and ConvergenceError if a step has no
    solution.
    """
    if isinstance(settings.body, Plate):
        raise ValueError("body plate cannot roll: give a cylinder or a sphere with its radius")
    radius = settings.body.radius_mm

    def travel(t: Floats) -> tuple[Floats, Floats]:
        part = np.clip(t / settings.roll_s, 0.0, 1.0)
        angle = np.deg2rad(settings.angle_deg) * (1 - np.cos(np.pi * part)) / 2
        return settings.start_x_mm + (radius + settings.axis_offset_mm) * angle, angle

    duration = settings.roll_s + settings.settle_s
    return _run(skin, settings, travel, duration, settings.start_x_mm, keep_forces)


def _run(
    skin: CondensedSkin,
    settings: SlideSettings | RollSettings,
    travel: Callable[[Floats], tuple[Floats, Floats]],
    motion_s: float,
    start_mm: float,
    keep_forces: bool,
) -> SkinTrial:
    press, dt = settings.press, settings.contact.step_us * 1e-6
    begin = press.loading_s + press.rest_s
    time: Floats = dt * np.arange(1.0, 1 + round((begin + motion_s) / dt) + 1)
    force = press.normal_force_N * (1 - np.cos(np.pi * np.clip(time / press.loading_s, 0, 1))) / 2
    x, angle = travel(time - begin)
    script = Script(force, x, angle, motion_s=begin, start_x_mm=start_mm)
    return follow(skin, settings, script, keep_forces=keep_forces)


@dataclass(frozen=True)
class Script:
    """Motion of an object, given at the end of every time step of the contact."""

    force_N: Floats
    """Normal force, (k,)."""
    x_mm: Floats
    """Position x of the object, (k,)."""
    angle_rad: Floats
    """Angle rolled so far, from 0, (k,)."""
    motion_s: float
    """Start of the slide or roll. Slip before it is not judged."""
    start_x_mm: float
    """Position x of the object before the first step."""


def follow(
    skin: CondensedSkin,
    settings: SlideSettings | RollSettings,
    script: Script,
    *,
    keep_forces: bool = False,
) -> SkinTrial:
    """Simulate the trial of a script.

    `settings` provides contact, object, transducer, sampling and ridge; its motion is not used.

    Raises ConvergenceError if a step has no solution.
    """
    dt = settings.contact.step_us * 1e-6
    stepper = make_stepper(
        skin,
        settings.contact,
        settings.body,
        position_mm=script.start_x_mm,
        watched_ridge=settings.ridge - 1,
        keep_forces=keep_forces,
        largest_force_N=max(LARGEST_FORCE_N, float(script.force_N.max())),
    )
    rotation = np.diff(script.angle_rad, prepend=0.0)
    block = stepper.advance(script.force_N, script.x_mm, rotation_rad=rotation)
    watch = SlipWatch(skin.ridge, dt, since_s=script.motion_s)
    watch.add(block.status)
    chain = TransducerChain(settings.transducer, dt)
    volts = chain.advance(block.stress_MPa[:, :, 1])
    filtered, picked = sample(volts, dt, settings.sample)
    time: Floats = dt * np.arange(1.0, 1 + script.force_N.size)
    return SkinTrial(
        time_s=time,
        motion_s=script.motion_s,
        block=block,
        truth=watch.truth(),
        volts=volts,
        filtered=filtered,
        sample_time_s=time[picked],
        sampled=filtered[picked],
    )


def sample(
    volts: Floats, step_s: float, settings: SampleSettings
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the volts (k, channels) behind the analogue filter, and the rows at which they are
    sampled.

    Raises ValueError if the sampling rate does not divide the step rate, or the filter is too fast
    for it.
    """
    from scipy.signal import butter, sosfilt

    rate = 1.0 / step_s
    every = round(rate / settings.rate_Hz)
    if every < 1 or abs(every * settings.rate_Hz - rate) > 1e-6 * rate:
        raise ValueError(
            f"rate_Hz {settings.rate_Hz:g} Hz must divide the step rate of {rate:g} Hz: "
            "samples fall on steps"
        )
    if settings.filter_Hz >= rate / 2:
        raise ValueError(
            f"filter_Hz {settings.filter_Hz:g} Hz must be below half the step rate, "
            f"{rate / 2:g} Hz: take smaller steps"
        )
    sections = butter(settings.filter_order, settings.filter_Hz, fs=rate, output="sos")
    filtered: Floats = np.asarray(sosfilt(sections, volts, axis=0))
    return filtered, np.arange(every - 1, volts.shape[0], every)


def high_frequency(signal: Floats, rate_Hz: float, corner_Hz: float = 100.0) -> Floats:
    """Return the part of a signal (n,) above `corner_Hz`, in its unit and shape, by a causal
    Butterworth filter of order 3."""
    from scipy.signal import butter, sosfilt

    sections = butter(3, corner_Hz, "highpass", fs=rate_Hz, output="sos")
    filtered: Floats = np.asarray(sosfilt(sections, signal))
    return filtered

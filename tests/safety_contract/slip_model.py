"""The pure skin model under the motion that a slip trial's file holds, and what both show.

Everything that is compared comes from the file: the positions measured at the ticks drive the
model, the strips' raw samples stand against the model's volts, both behind the reference case's
filter, and the World's record of slips says where to look. Only the height at which the skin
touches is the World's own. At 1 kHz an impulse of 2 ms is as large as the samples happen to meet
it, give or take a quarter; so the comparison is at the strips' own rate.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields

import numpy as np

from rig.physics.contact.settings import ContactSettings, Plate
from rig.physics.contact.stepper import ContactStepper
from rig.physics.transducer import TransducerChain, TransducerSettings
from rig.physics.trials import SampleSettings, high_frequency, sample

STEP_s = 1e-4
RATE_Hz = 1 / STEP_s
"""Of the model's steps, and of the strips."""
BEFORE_s, AFTER_s = 0.1, 0.3
"""Of the model's motion: from before the touch-down until after the third ridge's slip."""


@dataclass(frozen=True)
class Shown:
    """What v_d shows of a slide, in V."""

    hump: float
    """Median between the neighbour's slip and the beginning of shear."""
    neighbour: float
    """Pulse when ridge 2 slips, over the level that follows."""
    impulse: float
    """Largest excursion against the hump when ridge 3 slips."""
    hf_peak: float
    """Largest magnitude above 100 Hz then."""


def behind_filter(volts):
    """v_d (n,) of strips (n, 2) at the step rate, behind the reference case's filter."""
    filtered, _ = sample(volts, STEP_s, SampleSettings())
    return filtered[:, 0] - filtered[:, 1]


def shown(v_d, first_s, slide_s, whole_slip_s):
    """Figures of `v_d` (n,) whose first sample is at `first_s`, given when the slide began and when
    each ridge slipped as a whole."""
    t = first_s + np.arange(len(v_d)) / RATE_Hz
    second_s, third_s = whole_slip_s[1], whole_slip_s[2]
    between = lambda a, b: v_d[(t >= a) & (t <= b)]  # noqa: E731
    hump = float(np.median(between(slide_s + 0.03, second_s - 0.005)))
    pulse = between(second_s - 0.01, second_s + 0.01).max()
    fast = np.abs(high_frequency(v_d, RATE_Hz))
    return Shown(
        hump,
        float(pulse - np.median(between(second_s + 0.01, second_s + 0.02))),
        float(between(third_s - 0.01, third_s + 0.02).min()),
        float(fast[(t >= third_s - 0.01) & (t <= third_s + 0.02)].max()),
    )


@dataclass(frozen=True)
class Compared:
    """A trial beside the model under the motion that it measured."""

    measured: Shown
    modelled: Shown
    slip_order: list[int]
    """Ridges in the order in which they slipped as a whole in the World."""
    static_coefficient: float
    """Of the model's contact as a whole: its largest F_t / F_n."""

    def ratios(self):
        """Measured by modelled, by name."""
        return {
            f.name: getattr(self.measured, f.name) / getattr(self.modelled, f.name)
            for f in fields(Shown)
        }


def compare(run, point, reading, skin, contact_mm=12.4):
    """What a trial's v_d shows, and what the model's does under the measured motion."""
    series = {w.stream: w for w in run.waveforms(point)}
    truth = json.loads(reading["simulated_truth"])
    begun_us = truth["record_begun_us"]
    since = lambda us: 1e-6 * (np.array(us, float) - begun_us)  # noqa: E731
    slide_s, whole_s = float(since(truth["slide_us"])), since(truth["whole_slip_us"])
    touch_s = float(since(truth["touch_down_us"][-1]))
    strips = series["strips"]
    assert strips.rate_Hz == RATE_Hz
    raw = np.stack([strips.values(name) for name in ("strip_1", "strip_2")], axis=1)
    measured = shown(behind_filter(raw), 0.0, slide_s, whole_s)

    ticks = series["ticks"].values("elapsed")
    time = np.arange(touch_s - BEFORE_s, whole_s[2] + AFTER_s, STEP_s)
    z, x = (np.interp(time, ticks, series["position"].values(axis)) for axis in ("z", "x"))
    stepper = ContactStepper(skin, ContactSettings(), Plate(), position_mm=float(x[0]))
    block = stepper.advance(z - contact_mm, x, normal_control="position")
    chain = TransducerChain(TransducerSettings(), STEP_s)
    v_d = behind_filter(chain.advance(block.stress_MPa[:, :, 1]))
    sliding = time > slide_s
    static = (block.tangential_force_N[sliding] / block.normal_force_N[sliding]).max()
    return Compared(
        measured,
        shown(v_d, time[0] + STEP_s, slide_s, whole_s),  # a step ends at what begins it
        (np.argsort(whole_s) + 1).tolist(),
        float(static),
    )

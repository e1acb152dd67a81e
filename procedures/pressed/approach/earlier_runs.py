"""Compares a press with earlier runs of its kind on this bench, before the force is held."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_watch import SUSPECT
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from procedures.pressed.approach.tare import ForceZero
    from rig.run.context import Run
    from rig.run.press_references import TouchGain

REPORTED, REFUSED = 1.5, 2.5
"""Ratios of way or stiffness to the earlier ones, either way, beyond which a run is warned of and
refused. Friction and repeated mounting of one object change them by less than the first."""
MARGIN_mm = 0.02
"""Added to the largest way: a contact is felt a little sooner or later."""
SOON_mm, SOFTER = 0.01, 1 / 3
"""Distance beyond the earlier way at which the force must be at least this share of the wanted
one: what reads a tenth of the force is found before it has pressed with several times of it."""
ZERO_REPORTED_N, ZERO_REFUSED_N = 1.0, 5.0
"""The same for the change of the force sensor's zero."""
STANDARD_ERRORS = 3.0
"""Differences of a touch gain within so many of their standard errors are none."""
HINT = (
    "check the force sensor, its range and its calibration matrix; if this is a different object "
    "or sensor, make one run of this kind with --accept REASON"
)
GAIN_HINT = (
    "check the strip's cable and amplifier, and the force sensor; if this is a different skin or "
    "amplifier, make one run of this kind with --accept REASON"
)


class EarlierPress:
    """The reference for presses of one kind with one force, if there is one."""

    def __init__(self, run: Run, force_N: float, what: str = ""):
        """Look up the reference of presses with `force_N`.

        `what` distinguishes presses with the same force, see `PressedSettings.kind_of_press`.
        """
        self._run, self._force_N = run, force_N
        self._kind = f"{force_N:g} N {what}"
        self._reference = run.references.of(self._kind)

    @property
    def largest_way_mm(self) -> float:
        """Longest way of z from contact within which the force has to be reached."""
        if self._reference is None:
            return math.inf
        return REFUSED * self._reference.way_mm + MARGIN_mm

    def refuse_way(self, way_mm: float, force_N: float) -> None:
        """Stop z and raise InstrumentError where it has gone so far from contact that the sensor
        should have read the force, or `SOFTER` of it, and reads less."""
        if self._reference is None:
            return
        soft = way_mm > self._reference.way_mm + SOON_mm and force_N < SOFTER * self._force_N
        if not soft and way_mm <= self.largest_way_mm:
            return
        self._run.bench.stage_z.stop()
        raise InstrumentError(
            "force_sensor",
            "approach",
            f"it reads {force_N:.2g} N after {way_mm:.3f} mm from contact, where earlier runs of "
            f"this kind had {self._force_N:g} N after {self._reference.way_mm:.3f} mm (reference "
            f"of {self._reference.time})",
            HINT,
        )

    def refuse_missed(self, past_mm: float, force_N: float) -> None:
        """Stop z and raise InstrumentError where nothing is felt although z has gone past the place
        where this run has felt the object, farther than a press of this kind goes."""
        if past_mm <= self.largest_way_mm:
            return
        self._run.bench.stage_z.stop()
        raise InstrumentError(
            "force_sensor",
            "approach",
            f"it reads {force_N:.2g} N, {past_mm:.3f} mm below where this run has felt the object "
            "before",
            f"check whether the object is still there; otherwise {SUSPECT}",
        )

    def judge(self, way_mm: float, stiffness_N_mm: float, zero: ForceZero) -> None:
        """Compare a press that has reached its force. Raises InstrumentError where it does not fit
        the reference at all, and records a warning of what fits badly. The first press of a kind
        becomes the reference, and that of a run with ``--accept``."""
        if self._reference is None:
            self._remember(way_mm, stiffness_N_mm, zero)
            return
        earlier = self._reference
        ratio = stiffness_N_mm / earlier.stiffness_N_mm if earlier.stiffness_N_mm > 0 else 1.0
        size = max(ratio, 1 / ratio) if ratio > 0 else math.inf
        shift_N = max(abs(a - b) for a, b in zip(zero, earlier.zero_N, strict=True))
        found = []
        if size > REPORTED:
            found.append(
                f"the contact has {stiffness_N_mm:.3g} N/mm, and had {earlier.stiffness_N_mm:.3g} "
                "N/mm"
            )
        if shift_N > ZERO_REPORTED_N:
            found.append(f"the force sensor's zero is {shift_N:.2g} N away from where it was")
        if not found:
            return
        differs = (
            f"{' and '.join(found)} in earlier runs of this kind (reference of {earlier.time})"
        )
        if size > REFUSED or shift_N > ZERO_REFUSED_N:
            self._run.bench.stage_z.stop()
            raise InstrumentError("force_sensor", "press", differs, HINT)
        self._run.event("warning", "earlier-runs", f"{differs}; {HINT}")

    def judge_gains(self, gains: Mapping[str, TouchGain]) -> None:
        """Compare the strips' touch gains of a trial that is over. Raises InstrumentError where one
        does not fit the reference at all, a strip that gives nothing or the other sign among them,
        and records a warning of what fits badly. A strip that has no gain there sets it."""
        reference = self._run.references.of(self._kind)
        if reference is None:
            return
        for strip, gain in gains.items():
            earlier = reference.touch_gains.get(strip)
            if earlier is not None:
                self._judge_gain(strip, gain, earlier, reference.time)
            elif abs(gain.value_V_s_N) > STANDARD_ERRORS * gain.error_V_s_N:
                self._run.references.remember_gain(self._kind, strip, gain)

    def _judge_gain(self, strip: str, gain: TouchGain, earlier: TouchGain, time: str) -> None:
        error = math.hypot(gain.error_V_s_N, earlier.error_V_s_N)
        difference = gain.value_V_s_N - earlier.value_V_s_N
        beyond = max(0.0, abs(difference) - STANDARD_ERRORS * error)
        ratio = 1 + math.copysign(beyond, difference) / earlier.value_V_s_N
        size = max(ratio, 1 / ratio) if ratio > 0 else math.inf
        if size <= REPORTED:
            return
        differs = (
            f"the touch gain of {strip} is {gain.value_V_s_N:.3g} V s/N, and was "
            f"{earlier.value_V_s_N:.3g} V s/N in earlier runs of this kind (reference of {time})"
        )
        if size > REFUSED:
            raise InstrumentError("daq", "touch-down", differs, GAIN_HINT)
        self._run.event("warning", "earlier-runs", f"{differs}; {GAIN_HINT}")

    def _remember(self, way_mm: float, stiffness_N_mm: float, zero: ForceZero) -> None:
        references = self._run.references
        if not references.compares:
            return
        zero_N = (zero.x_N, zero.y_N, zero.z_N)
        references.remember(self._kind, way_mm, stiffness_N_mm, zero_N)
        why = f"accepted: {references.accept}" if references.accept else "the first of its kind"
        self._run.event(
            "info",
            "earlier-runs",
            f"this press becomes the reference for later runs ({why}): {stiffness_N_mm:.3g} N/mm, "
            f"{way_mm:.3f} mm from contact to {self._force_N:g} N; there was nothing to compare "
            "it with",
        )

"""The skin above an object in the World: force and volts from the stages' positions.

The skin hangs on the carriage of the x-z stage, ridges down, its first ridge towards +x; below it
the object, a plate or a head on the rotary stage, stands on the force sensor. z presses, x slides,
the rotary stage rolls. Signs: F_n is what the skin presses on the object with, positive along the
sensor's z; F_t is what it drags the object with, positive along x while the stage moves towards +x.
The stages are pushed back with -F_n and -F_t. Seen from the skin the object slides towards +x when
the stage does: the reference slide of `rig.physics.trials`.

The contact goes in whole steps (0.1 ms), computed when needed and stored for a while, so that a
converter may sample the past. What a step finds from the stages' positions at its beginning is
force and volts at its end, so a value that was returned never changes; between steps it is linear.
The same motion gives the same bits, whatever the stretches of time in which it was asked for:
blocks end at fixed instants, and a skin that nothing touches comes to rest at one of these.

It asks the stages where they were and may not move them. A step without a solution is a failure
that stays: the contact keeps its last values from there on, and whoever owns the World has to end
it (see `SkinContact.failure`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.simulated.world.slip_record import SlipRecord
from rig.core.settings import Settings
from rig.physics.contact.settings import ContactSettings, Plate, Sphere
from rig.physics.contact.slices import SlicedStepper
from rig.physics.contact.stepper import OPEN, ContactStepper, ConvergenceError
from rig.physics.transducer import TransducerChain, TransducerSettings

if TYPE_CHECKING:
    from drivers.simulated.world.contact_geometry import Below, ContactGeometry
    from rig.physics.skin.condensed import CondensedSkin

Reals = npt.NDArray[np.float64]
Report = Callable[[str, object], None]
"""Writes what happened to the World's log."""

KEPT_s = 30.0
"""Length of the stored history: longer than any acquisition's way to its reader."""
BLOCK_STEPS = 100
"""Steps between the instants at which the skin may come to rest."""
LOGGED_STEPS = 5 * BLOCK_STEPS
"""Steps between those at which slips are searched for and logged without being asked for."""
AT_REST_mm = 1e-12
"""A skin that nothing touches and that is displaced by less everywhere is at rest."""
TANGENTIAL_N, NORMAL_N, STRIP_1_V, STRIP_2_V = range(4)


class SkinMountSettings(Settings):
    """Mounting of the skin above the object."""

    contact_mm: float = Field(default=12.4, gt=0)
    """Position of the z stage at which the skin just touches the object."""
    ridge: int = Field(default=3, ge=1)
    """The ridge that holds the strips, 1 is the one towards +x."""
    gain_mismatch: float = Field(default=0.0, gt=-1, lt=1)
    """Relative excess of the gain of strip 1's amplifier over that of strip 2."""
    jitter_um: float = Field(default=0.0, ge=0)
    """Peak of a vibration of the stage along x."""
    jitter_Hz: float = Field(default=50.0, gt=0)
    """Frequency of the jitter."""


class SkinContact:
    """The contact of skin and object over World time."""

    def __init__(
        self,
        skin: CondensedSkin,
        mount: SkinMountSettings,
        contact: ContactSettings,
        transducer: TransducerSettings,
        below: Below,
        report: Report,
    ):
        """Prepare the contact, whose geometry is `below`. Raises ValueError for a step that no
        millisecond holds a whole number of; loading the compiled step takes its time here."""
        self.step_us = round(contact.step_us)
        if self.step_us != contact.step_us or 1000 % self.step_us:
            raise ValueError(
                f"contact.step_us {contact.step_us:g} us must be whole and divide 1000 us: "
                "the stages poll their load once a millisecond"
            )
        self.failure: str | None = None
        """Reason why the contact is frozen since a step had no solution."""
        self._skin, self._mount = skin, mount
        self._contact, self._transducer = contact, transducer
        self._below = below
        self._rolls = not isinstance(below.body, Plate)
        self._report = report
        self.record = SlipRecord(skin.ridge, mount.ridge - 1, self.step_us, report)
        self._kept = round(KEPT_s * 1e6) // self.step_us
        self._results = np.zeros((4, 2 * self._kept))
        """F_t, F_n and the volts of S1 and S2 for each step; column 0 belongs to step
        ``_oldest``."""
        self._oldest = 0
        self._steps = 0
        """Steps done. Step n ends at n steps' time; the World begins with step 0."""
        self._stepper: ContactStepper | SlicedStepper | None = None
        """None while the skin is at rest."""
        self._chain = self._fresh_chain()
        self._stresses: list[Reals] = []
        """Stresses of the newest steps, whose volts have not been asked for."""
        begin = below.at(np.zeros(1, np.int64))
        self._object_at_mm, self._turned_rad = float(begin.x_mm[0]), float(begin.turned_rad[0])
        """Position and angle of the object relative to the skin, at the newest step."""
        # numba compiles or loads its machine code now, not at the first touch
        self._fresh_stepper().advance(-1.0, self._object_at_mm, normal_control="position")

    # --- what the World asks ------------------------------------------------------------------

    def force_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the force in N on the plate along x, y, z, (n, 3), at ascending World times in s,
        (n,), none in the future."""
        force = np.zeros((len(times_s), 3))
        force[:, 0], force[:, 2] = self._at((TANGENTIAL_N, NORMAL_N), times_s)
        return force

    def strip_V(self, strip: int, times_s: Reals) -> Reals:  # noqa: N802
        """Return the output of strip 1 or 2's amplifier at such times; shape of `times_s`."""
        if times_s.size:
            self.catch_up(math.floor(float(times_s[-1]) * 1e6))
            self._make_volts()
        (volts,) = self._at((STRIP_1_V if strip == 1 else STRIP_2_V,), times_s)
        half = self._mount.gain_mismatch / 2
        return volts * (1 + half if strip == 1 else 1 - half)

    def push_N(self, t_us: int) -> tuple[float, float]:  # noqa: N802
        """Return F_t and F_n in N that the stages' positions at a World time lead to."""
        self.catch_up(t_us)
        column = max(t_us // self.step_us + 1 - self._oldest, 0)
        tangential, normal = self._results[:2, column].tolist()
        return tangential, normal

    def truth(self) -> dict[str, Any]:
        """Return the record of touches and slips with the friction behind it, as JSON."""
        friction = self._contact.friction
        return {
            **self.record.truth(),
            "static_coefficient": friction.static_coefficient,
            "kinetic_coefficient": friction.kinetic_coefficient,
            "weakening_distance_um": friction.weakening_distance_um,
        }

    def catch_up(self, t_us: int) -> None:
        """Do every step that begins at or before a World time."""
        last = t_us // self.step_us
        if last < self._steps:
            return
        first = self._steps
        if self._at_rest and self._below.apart(first * self.step_us, last * self.step_us):
            self._stay_apart(last)
            return
        times = np.arange(first, last + 1) * self.step_us
        meeting = self._below.at(times)
        done = self._steps - first  # stages that move have asked for their load meanwhile
        if done < times.size:
            self._advance(meeting[done:])

    # --- one step after the other -------------------------------------------------------------

    @property
    def _at_rest(self) -> bool:
        return self._stepper is None and self.failure is None

    def _stay_apart(self, last: int) -> None:
        """Compute the steps up to `last`, in which nothing is touched."""
        end = self._below.at(np.array([last * self.step_us]))
        idle = last + 1 - self._steps  # stages that move have asked for their load meanwhile
        if idle > 0:
            self._remember(end, last)
            self._keep(np.zeros((4, idle)))

    def _remember(self, passed: ContactGeometry, last: int) -> None:
        """Store the positions of the object while nothing touches it; `last` is the step of the
        newest."""
        shaken_mm = self._shaken_mm(passed.x_mm[-1:], last)
        self._object_at_mm = float(shaken_mm[0])
        self._turned_rad = float(passed.turned_rad[-1])

    def _shaken_mm(self, x_mm: Reals, first: int) -> Reals:
        """Return the object as the skin sees it in the steps from `first` on, x being where the
        stages mean it."""
        if not self._mount.jitter_um:
            return x_mm
        turns = self._mount.jitter_Hz * 1e-6 * self.step_us * (first + np.arange(x_mm.size))
        shaken: Reals = x_mm + 1e-3 * self._mount.jitter_um * np.sin(2 * math.pi * turns)
        return shaken

    def _advance(self, meeting: ContactGeometry) -> None:
        approach, begin = meeting.approach_mm, 0
        while begin < approach.size:
            if self._at_rest:
                pressed = np.flatnonzero(approach[begin:] > 0)
                idle = int(pressed[0]) if pressed.size else approach.size - begin
                if idle:
                    self._remember(meeting[begin : begin + idle], self._steps + idle - 1)
                self._keep(np.zeros((4, idle)))
                begin += idle
                if not pressed.size:
                    return
                self._stepper = self._fresh_stepper()
            steps = min(BLOCK_STEPS - self._steps % BLOCK_STEPS, approach.size - begin)
            self._do(meeting[begin : begin + steps])
            begin += steps

    def _do(self, meeting: ContactGeometry) -> None:
        """Compute the steps of one block or of a part of it."""
        approach, x_mm, turned = meeting.approach_mm, meeting.x_mm, meeting.turned_rad
        if self._stepper is None:
            self._keep(np.repeat(self._newest(), approach.size, axis=1))
            return
        place = self._shaken_mm(x_mm, self._steps)
        turns = np.diff(turned, prepend=self._turned_rad) if self._rolls else None
        try:
            block = self._stepper.advance(
                approach, place, rotation_rad=turns, normal_control="position"
            )
        except ConvergenceError as error:
            self._fail(str(error))
            self._keep(np.repeat(self._newest(), approach.size, axis=1))
            return
        self.record.add(self._steps, block.status, x_mm)
        self._stresses.append(block.stress_MPa[:, :, 1])
        results = np.zeros((4, x_mm.size))
        results[TANGENTIAL_N], results[NORMAL_N] = block.tangential_force_N, block.normal_force_N
        self._keep(results)
        self._object_at_mm, self._turned_rad = float(place[-1]), float(turned[-1])
        rests = self._steps % BLOCK_STEPS == 0 and self._rests(block.status[-1])
        if rests or self._steps % LOGGED_STEPS == 0:
            self._make_volts()
            self.record.judge()
        if rests:
            self._stepper, self._chain = None, self._fresh_chain()

    def _make_volts(self) -> None:
        """Bring the strips' volts up to the newest step."""
        if not self._stresses:
            return
        volts = self._chain.advance(np.concatenate(self._stresses))
        self._stresses = []
        end = self._steps + 1 - self._oldest
        begin = max(end - len(volts), 0)  # what comes before it has been forgotten
        self._results[STRIP_1_V:, begin:end] = volts[begin - end :].T

    def _rests(self, status: npt.NDArray[np.int8]) -> bool:
        assert self._stepper is not None
        if (status != OPEN).any():
            return False
        return all(np.abs(u).max() < AT_REST_mm for u in self._stepper.displacement_mm())

    def _fail(self, why: str) -> None:
        self._make_volts()
        self.record.judge()
        self.failure = f"after {self._steps * self.step_us} us: {why}"
        self._stepper = None
        self._report("contact-failed", self.failure)

    def _fresh_stepper(self) -> ContactStepper | SlicedStepper:
        body, ridge = self._below.body, self._mount.ridge - 1
        place = self._object_at_mm
        if isinstance(body, Sphere):
            return SlicedStepper(
                self._skin, self._contact, body, position_mm=place, watched_ridge=ridge, beyond=True
            )
        return ContactStepper(
            self._skin, self._contact, body, position_mm=place, watched_ridge=ridge
        )

    def _fresh_chain(self) -> TransducerChain:
        chain = TransducerChain(self._transducer, self.step_us * 1e-6)
        chain.advance(np.zeros((1, 2)))  # at rest before the first touch
        return chain

    # --- history ------------------------------------------------------------------------------

    def _newest(self) -> Reals:
        column = self._steps - self._oldest
        newest: Reals = self._results[:, column : column + 1].copy()
        return newest

    def _keep(self, results: Reals) -> None:
        """Append results (4, k) of the next steps."""
        for begin in range(0, results.shape[1], self._kept):
            fresh = results[:, begin : begin + self._kept]
            end = self._steps + 1 - self._oldest
            if end + fresh.shape[1] > self._results.shape[1]:
                self._results[:, : self._kept] = self._results[:, end - self._kept : end].copy()
                self._oldest += end - self._kept
                end = self._kept
            self._results[:, end : end + fresh.shape[1]] = fresh
            self._steps += fresh.shape[1]

    def _at(self, rows: Sequence[int], times_s: Reals) -> list[Reals]:
        """Return results between the steps."""
        if not times_s.size:
            return [np.zeros_like(times_s) for _ in rows]
        step_s = self.step_us * 1e-6
        self.catch_up(math.floor(float(times_s[-1]) * 1e6))
        first = max(math.floor(float(times_s[0]) / step_s) - 1, self._oldest)
        grid = np.arange(first, self._steps + 1) * step_s
        kept = self._results[:, first - self._oldest : self._steps + 1 - self._oldest]
        return [np.interp(times_s, grid, kept[row]) for row in rows]

"""Parameters of the incipient-slip detectors. They are one object, which is stored with every
result."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from rig.core.settings import Settings
from rig.detector.low_pass import LowPassSettings
from rig.detector.network import Network, trained_network

Logic = Literal["rig", "paper-literal", "paper-hp", "impulse"]
"""Names of the detector logics."""


class DetectorSettings(Settings):
    """Parameters that determine how v_1 and v_2 become events.

    Every threshold is the larger of an absolute floor in mV and a multiple of the measured noise:
    the published logics measure it in quiet pieces, ``rig`` and ``impulse`` throughout. A relative
    threshold alone fails where there is hardly any noise.
    """

    logic: Logic = "rig"
    """Logic of the detector. ``paper-literal``: v_d itself exceeds a threshold while armed (paper
    4.3); ``paper-hp``: v_d above `impulse_Hz` does; ``rig``: `network` judges both channels;
    ``impulse``: see `ImpulseSettings`."""
    low_pass: LowPassSettings = LowPassSettings()
    """Low-pass filter that extracts the predictive signal from v_d."""
    impulse_Hz: float = Field(100.0, gt=0)
    """-3 dB frequency of the high-pass filter that extracts the impulse (Butterworth, third
    order)."""
    quiet_s: float = Field(0.25, gt=0)
    """Length of the pieces on which offset and noise are measured. The published logics use quiet
    pieces, every fourth one after the first. ``rig`` (with a network of 41 inputs or more) and
    ``impulse`` measure noise on every piece and take the second least of the latest 16."""
    least_noise_mV: float = Field(0.02, gt=0)
    """Lowest noise that is assumed, rms."""
    arm_mV: float = Field(0.4, gt=0)
    """Lowest threshold on the predictive signal for arming; see also `arm_sigmas`."""
    arm_sigmas: float = Field(5.0, gt=0)
    """Threshold for arming in standard deviations of the predictive signal's noise. The signal has
    to exceed `arm_mV` as well."""
    armed_s: float = Field(0.15, gt=0)
    """Time for which the detector stays armed after the predictive signal was last above half its
    threshold."""
    fire_mV: float = Field(10.0, gt=0)
    """Published logics: an impulse above this threshold is a slip; see also `fire_sigmas`."""
    fire_sigmas: float = Field(5.0, gt=0)
    """The same threshold in standard deviations of the signal's noise. An impulse has to exceed
    `fire_mV` as well."""
    look_mV: float = Field(0.15, gt=0)
    """The network is evaluated at every row for 12 ms after an impulse above this threshold and
    `look_sigmas`, otherwise every 4 ms, or every 8 ms by a network of fewer than 41 inputs."""
    look_sigmas: float = Field(3.0, gt=0)
    """The same threshold in standard deviations of the signal's noise."""
    fire_probability: float = Field(0.9, gt=0, lt=1)
    """Probability of a slip, from the network, above which a slip is reported."""
    roll_probability: float = Field(0.9, gt=0, lt=1)
    """Probability of a roll, from the network, above which a roll is reported."""
    silence_s: float = Field(0.15, gt=0)
    """Time after a reported slip in which no other slip is reported."""
    saturation_V: float = Field(9.95, gt=0)
    """A channel is saturated at or beyond this voltage. Nothing is judged until 50 ms after it."""
    dead_s: float = Field(0.5, gt=0)
    """A channel is dead if it has not changed at all for this time while the other one moved by
    more than `dead_mV`."""
    dead_mV: float = Field(5.0, gt=0)
    """Change of one channel from which the other one, if it does not change, may be dead."""
    hum_mV: float = Field(2.0, gt=0)
    """Mains hum with an amplitude above this is reported."""
    network: Network | None = None
    """Weights of the logic ``rig``."""

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if (self.network is None) == (self.logic == "rig"):
            raise ValueError(
                f"logic {self.logic!r} and network "
                f"{'none' if self.network is None else self.network.name!r}: the logic 'rig' needs "
                "a trained network, the published ones have none"
            )
        return self


class RigSettings(DetectorSettings):
    """Parameters of the logic ``rig``."""

    fire_probability_with_x: float | None = Field(None, gt=0, lt=1)
    """The same as `fire_probability` in trials in which the commands of x are known: they explain
    what a stop or a turn does to v_d (decision 0121). None: no other one."""
    first_probability: float | None = Field(None, gt=0, lt=1)
    """Probability above which the first slip since the detector was last disarmed is reported, if
    it is larger than that of further ones: it is disarmed when a motion under load has been over
    for `armed_s` (decision 0147). None: the same as for further ones."""
    turn_probability: float | None = Field(None, gt=0, lt=1)
    """Probability above which a slip is reported within `turn_s` after x was commanded to move
    against its latest direction, if it is larger than that of others: most false alarms in
    reversals came then (decision 0150). None: the same as for others."""
    turn_s: float | None = Field(None, gt=0)
    """Time after a commanded turn in which `turn_probability` applies."""
    over_probability: float | None = Field(None, gt=0, lt=1)
    """A slip is over once its probability has fallen below this. A further one may then be reported
    before `silence_s` has passed: an alarm at a partial slip must not hide the slip of the whole
    ridge (decision 0122). None: `silence_s` always passes."""
    again_s: float | None = Field(None, gt=0)
    """Time between two reported slips that passes in any case. None: 40 ms, as it always was before
    decision 0136."""

    @model_validator(mode="after")
    def _states_both(self) -> Self:
        if (self.turn_probability is None) != (self.turn_s is None):
            raise ValueError("turn_probability and turn_s must be stated together")
        return self

    @model_serializer(mode="wrap")
    def _as_before(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what parameters of earlier versions do not state.

        Their fingerprint, which is in processed files and their names, thus remains the same.
        """
        plain: dict[str, Any] = serialize(self)
        for later in (
            "fire_probability_with_x", "first_probability", "turn_probability", "turn_s",
            "over_probability", "again_s",
        ):  # fmt: skip
            if plain[later] is None:
                del plain[later]
        return plain


class ImpulseSettings(DetectorSettings):
    """Parameters of the logic ``impulse``: as ``paper-hp``, but the threshold follows the first
    touch-down, the motion need not arm, and commands of x are used where they are known.

    They were chosen on trials of the simulated bench (decision 0116).
    """

    logic: Logic = "impulse"
    fire_mV: float = Field(8.0, gt=0)
    """An impulse above this threshold is a slip, after the standard touch-down (to 4 N on the
    reference skin); see also `fire_sigmas`."""
    fire_sigmas: float = Field(6.0, gt=0)
    """The same threshold in standard deviations of the signal's noise. An impulse has to exceed
    `fire_mV` as well."""
    touch_exponent: float = Field(0.4, ge=0, le=1)
    """The threshold grows with this power of the touch-down's size."""
    silence_s: float = Field(0.06, gt=0)
    """Time after a reported slip in which no other slip is reported: an early alarm must not hide
    the slip."""
    braking_s: float = Field(0.03, ge=0)
    """Time for which `braking_share` raises the threshold, after x was commanded to stop, to turn,
    or to move at less than half of its speed."""
    braking_share: float = Field(0.5, ge=0)
    """Share of the recent level of v_d, which a braking motion takes away, by which the threshold
    is then higher."""


def settings_from_json(text: str) -> DetectorSettings:
    """Return the parameters of a detector of this project from the JSON in a processed file.

    Raises ValueError for a text that is not of such parameters.
    """
    stated = json.loads(text)
    logic = stated.get("logic") if isinstance(stated, dict) else None
    kinds: dict[str, type[DetectorSettings]] = {"rig": RigSettings, "impulse": ImpulseSettings}
    return kinds.get(str(logic), DetectorSettings).model_validate_json(text)


@lru_cache(maxsize=1)
def named_detectors() -> dict[str, DetectorSettings]:
    """Return the parameters of all detectors that have a name.

    `rig.detector.DEFAULT_DETECTOR` is the name of the default.
    """
    rig = RigSettings(
        network=trained_network(),
        fire_probability=0.95,
        fire_probability_with_x=0.9,
        turn_probability=0.98,
        turn_s=0.05,
        over_probability=0.2,
        again_s=0.02,
    )
    return {
        "rig": rig,
        "rig-grip": rig.model_copy(update={"first_probability": 0.99}),
        # The lowest threshold that alarms in at most 2 % of simulated rolls (decision 0049). It
        # misses slow slides, the default one by 1.3 mV: `rig detect` says so and why.
        "paper-literal": DetectorSettings(logic="paper-literal", fire_mV=30.0),
        "paper-hp": DetectorSettings(logic="paper-hp"),
        "impulse": ImpulseSettings(),
    }

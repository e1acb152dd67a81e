"""The detectors of this project, as they are registered in the entry-point group `rig.detectors`.

Their docstrings are the lines of `rig detectors`. The parameters are in `rig.detector.settings`.
"""

from __future__ import annotations

from typing import ClassVar, cast

from rig.core import settings as core_settings
from rig.detector.detector import IncipientSlipDetector, NETWORK_RATE_Hz
from rig.detector.settings import (
    DetectorSettings,
    ImpulseSettings,
    RigSettings,
    named_detectors,
)


class _OwnDetector(IncipientSlipDetector):
    name: ClassVar[str]

    @classmethod
    def default_settings(cls) -> DetectorSettings:
        """Return the parameters of this detector."""
        return named_detectors()[cls.name]

    @classmethod
    def seeds_seen(
        cls, settings: core_settings.Settings
    ) -> tuple[int, int] | list[tuple[int, int]] | None:
        """Return the first and last seed on which the network was trained, if it has one."""
        network = cast(DetectorSettings, settings).network
        return None if network is None else (network.first_seed, network.last_seed)


TURNS_SEEN_ON = 1_013_303, 1_013_522
"""First and last seed of the reporting seeds on which the alarms after turns were seen that
`turn_probability` avoids (decision 0150)."""
FIRST_CHOSEN_ON = 1_006_446, 1_006_560
"""The same of those on which `first_probability` of ``rig-grip`` was chosen (decision 0147)."""


class Rig(_OwnDetector):
    """A small network judges v_1 - v_2 and v_1 + v_2; it distinguishes rolls from slips."""

    Settings = RigSettings
    name = "rig"
    slowest_Hz = (1 - 1e-3) * NETWORK_RATE_Hz
    fastest_Hz = (1 + 1e-3) * NETWORK_RATE_Hz

    @classmethod
    def with_threshold(
        cls, settings: core_settings.Settings, factor: float
    ) -> core_settings.Settings:
        """Return the parameters with the odds of a slip multiplied by the square of `factor`."""
        own = cast(RigSettings, settings)
        changed = {}
        for name in (
            "fire_probability", "fire_probability_with_x", "first_probability", "turn_probability",
        ):  # fmt: skip
            probability = getattr(own, name)
            if probability is not None:
                odds = factor**2 * probability / (1 - probability)
                changed[name] = odds / (1 + odds)
        return settings.model_copy(update=changed)

    @classmethod
    def seeds_seen(cls, settings: core_settings.Settings) -> list[tuple[int, int]]:
        """Return the seeds on which the network was trained, and the reporting seeds on which a
        threshold was chosen: these are not reported of it."""
        own = cast(RigSettings, settings)
        assert own.network is not None, "the logic rig has one"
        seen = [(own.network.first_seed, own.network.last_seed)]
        if own.turn_probability is not None:
            seen.append(TURNS_SEEN_ON)
        if own.first_probability is not None:
            seen.append(FIRST_CHOSEN_ON)
        return seen


class RigForGrips(Rig):
    """The detector rig with a higher threshold for the first slip of a motion: for --regrip."""

    name = "rig-grip"


class _Published(_OwnDetector):
    @classmethod
    def with_threshold(
        cls, settings: core_settings.Settings, factor: float
    ) -> core_settings.Settings:
        """Return the parameters with `factor` times both thresholds of a slip."""
        own = cast(DetectorSettings, settings)
        fire = {"fire_mV": factor * own.fire_mV, "fire_sigmas": factor * own.fire_sigmas}
        return settings.model_copy(update=fire)


class PaperLiteral(_Published):
    """The paper's logic, read literally: v_d itself passes a threshold while armed."""

    name = "paper-literal"


class Impulse(_Published):
    """The detector paper-hp with a threshold that follows the first touch and the commands of x."""

    Settings = ImpulseSettings
    version = "1"
    name = "impulse"

    @classmethod
    def seeds_seen(cls, settings: core_settings.Settings) -> tuple[int, int] | None:
        """Return the seeds of the trials on which the thresholds were chosen."""
        return 0, 30


class PaperHighPassed(_Published):
    """The paper's logic on the part of v_d above 100 Hz. It is the default."""

    name = "paper-hp"

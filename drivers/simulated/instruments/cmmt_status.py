"""What a CMMT drive shows in the input image of telegram 111."""

from __future__ import annotations

from drivers.simulated.instruments.cmmt_motion import CmmtMotion
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.cmmt_telegram import IMAGE_WORDS, OutputImage, halves, word

ARRIVED_mm = 0.01
"""Window of "target reached"."""
NOMINAL_SPEED_mm_s = 1000.0
"""Speed that NIST_B defines as 100 %."""


def input_image(
    settings: SimulatedCmmtSettings,
    image: OutputImage,
    motion: CmmtMotion,
    t_us: int,
    *,
    fault: int,
    enabled: bool,
    enabling: bool,
    shows_off_mm: float,
) -> list[int]:
    """Return the input image at a World time, under the output image that was written last.

    `enabling` is true while the drive is about to be enabled; `shows_off_mm` is the error of the
    position that it shows.
    """
    axis = motion.axis
    position, velocity = axis.position(t_us), axis.velocity(t_us)
    shown_mm = motion.reference.own_mm(position) + shows_off_mm
    inhibited = bool(fault) or (image.bit(0, 0) and not enabled and not enabling)
    words = [
        _zsw1(settings, image, motion, t_us, position, velocity, bool(fault), enabled, inhibited),
        _pos_zsw1(settings, motion, position),
        _pos_zsw2(motion, t_us, velocity),
        motion.at_fixed_stop << 8 | enabled << 11,
        enabled << 11 | enabled << 13,
        *halves(round(shown_mm / settings.position_unit_mm)),
        *halves(round(velocity / NOMINAL_SPEED_mm_s * 0x40000000)),
        fault,
        motion.warning,
    ]
    return words + [0] * (IMAGE_WORDS - len(words))


def _zsw1(
    settings: SimulatedCmmtSettings,
    image: OutputImage,
    motion: CmmtMotion,
    t_us: int,
    position: float,
    velocity: float,
    fault: bool,
    enabled: bool,
    inhibited: bool,
) -> int:
    axis, resting = motion.axis, motion.axis.finished(t_us)
    speeding = axis.acceleration(t_us) * velocity
    error = abs(axis.following_error(t_us))
    arrived = (
        motion.target_mm is not None and resting and abs(position - motion.target_mm) <= ARRIVED_mm
    )
    return word(
        not inhibited,
        not inhibited and image.bit(0, 0),
        enabled,
        fault,
        image.bit(0, 1),
        image.bit(0, 2),
        inhibited,
        bool(motion.warning),
        error <= settings.mechanics.following_window_mm,
        True,
        arrived or motion.at_fixed_stop,
        motion.reference.homed,
        motion.acknowledged,
        velocity == 0 and resting,
        speeding > 0,
        speeding < 0,
    )


def _pos_zsw1(settings: SimulatedCmmtSettings, motion: CmmtMotion, position: float) -> int:
    mechanics = settings.mechanics
    return (
        (position <= mechanics.low_switch_mm) << 8
        | (position >= mechanics.high_switch_mm) << 9
        | (motion.jogging != 0) << 10
        | motion.homing << 11
        | (motion.target_mm is not None) << 15
    )


def _pos_zsw2(motion: CmmtMotion, t_us: int, velocity: float) -> int:
    return (
        (motion.target_mm is not None) << 2
        | (velocity > 0) << 4
        | (velocity < 0) << 5
        | motion.at_fixed_stop << 12
        | motion.at_fixed_stop << 13
        | motion.seeking << 14
        | (motion.busy and not motion.axis.finished(t_us)) << 15
    )

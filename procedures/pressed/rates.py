"""How often a servo acts under the force, and how often the stages are asked, as links allow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from procedures.pressed.settings import DELAY_S, LINK_S, LOOKS_Hz, PressedSettings, TICK_Hz

if TYPE_CHECKING:
    from rig.run.context import Run


@dataclass(frozen=True)
class Pace:
    """How often the servo acts and the stages are asked: as their links allow."""

    tick_Hz: float
    """Of the servo."""
    delay_s: float
    """From a command to the first force that shows it."""
    looks_Hz: float
    """How often both stages are asked where they are, at most."""
    link_s: float = LINK_S
    """A look and a new target of z take so long at most, usually."""

    @property
    def tick_s(self) -> float:
        """From one tick of the servo to the next."""
        return 1 / self.tick_Hz

    @property
    def approach_s(self) -> float:
        """From one tick of an approach to the next, each of which asks z where it is."""
        return max(self.tick_s, 1 / LOOKS_Hz)


def pace_on(run: Run) -> Pace:
    """As often as was asked for, or as the stages' links have time for, which is told where it is
    less often than usual."""
    settings: PressedSettings = run.settings
    z_Hz, x_Hz = (
        stage.reach()["update_rate"].high for stage in (run.bench.stage_z, run.bench.stage_x)
    )
    both_Hz = 1 / (1 / z_Hz + 1 / x_Hz)
    tick_Hz = settings.tick_Hz or min(TICK_Hz, z_Hz if settings.updates_a_tick == 1 else both_Hz)
    if tick_Hz < TICK_Hz and settings.tick_Hz is None:
        run.event(
            "warning",
            "servo",
            f"the servo holds the force at {tick_Hz:.3g} Hz, as often as the stages' links have "
            f"time for, not at {TICK_Hz:g} Hz: the force errors show what it costs",
        )
    delay_s = DELAY_S + max(0.0, 1 / z_Hz - LINK_S) / 2
    return Pace(tick_Hz, delay_s, min(LOOKS_Hz, both_Hz), max(LINK_S, 1 / z_Hz))

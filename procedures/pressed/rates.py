"""The rates of the force servo and of the stages' polls, as their links allow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from procedures.pressed.settings import DELAY_S, LINK_S, POLL_RATE_Hz, PressedSettings, TICK_Hz

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.run.context import Run


@dataclass(frozen=True)
class ServoRates:
    """Rates at which the servo acts and the stages are polled, as their links allow."""

    tick_Hz: float
    """Ticks of the servo per second."""
    delay_s: float
    """Time in s from a command to the first force that shows it, with a force sensor at
    `FORCE_RATE_S_S`."""
    poll_rate_Hz: float
    """Highest rate at which both stages are polled."""
    link_s: float = LINK_S
    """Usual longest time in s of a poll and a new target of z together."""

    @property
    def tick_s(self) -> float:
        """Time in s from one tick of the servo to the next."""
        return 1 / self.tick_Hz

    @property
    def approach_s(self) -> float:
        """Time in s from one tick of an approach to the next; each of them polls z."""
        return max(self.tick_s, 1 / POLL_RATE_Hz)


def rates_for(bench: Bench, settings: PressedSettings) -> ServoRates:
    """Return the rates that were asked for, or else what the links of z and x have time for.

    Stages with slow links are polled less often than usual.
    """
    z_Hz, x_Hz = (stage.limits()["update_rate"].high for stage in (bench.stage_z, bench.stage_x))
    both_Hz = 1 / (1 / z_Hz + 1 / x_Hz)
    tick_Hz = settings.tick_Hz or min(TICK_Hz, z_Hz if settings.updates_a_tick == 1 else both_Hz)
    delay_s = DELAY_S + max(0.0, 1 / z_Hz - LINK_S) / 2
    return ServoRates(tick_Hz, delay_s, min(POLL_RATE_Hz, both_Hz), max(LINK_S, 1 / z_Hz))


def warn_of_slow_links(run: Run, rates: ServoRates) -> None:
    """Record a warning where the servo is slower than usual because of the stages' links."""
    if rates.tick_Hz < TICK_Hz and run.settings.tick_Hz is None:
        run.event(
            "warning",
            "servo",
            f"the servo holds the force at {rates.tick_Hz:.3g} Hz, as often as the stages' links "
            f"have time for, not at {TICK_Hz:g} Hz: the force errors show what it costs",
        )

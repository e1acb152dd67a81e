"""Checks of limits at every call, before anything is sent to an instrument."""

from __future__ import annotations

from collections.abc import Mapping

from rig.core.errors import (
    LimitError,
)
from rig.instruments.roles import (
    Identity,
    Limits,
    SignalGenerator,
)


class GuardedGenerator:
    """A signal generator that refuses values outside the bench's limits at every call."""

    def __init__(self, inner: SignalGenerator):
        self._inner = inner

    @property
    def identity(self) -> Identity:
        """The generator's identity as read when it was connected."""
        return self._inner.identity

    def limits(self) -> Mapping[str, Limits]:
        """Return the generator's limits."""
        return self._inner.limits()

    def sine(self, frequency_Hz: float, amplitude_V: float) -> None:
        """Set a sine. Raises LimitError for a value outside the limits, before anything is sent."""
        limits = self._inner.limits()
        require("frequency", frequency_Hz, limits["frequency"])
        require("amplitude", amplitude_V, limits["amplitude"])
        self._inner.sine(frequency_Hz, amplitude_V)

    def output(self, on: bool) -> None:
        """Switch the output on or off."""
        self._inner.output(on)

    def output_is_on(self) -> bool:
        """Return whether the output is on."""
        return self._inner.output_is_on()

    def make_safe(self) -> None:
        """Switch the output off."""
        self._inner.make_safe()

    def close(self) -> None:
        """Close the link."""
        self._inner.close()


def require(what: str, value: float, limits: Limits, where: str = "") -> None:
    """Raise LimitError, which names value, unit, limit, device and place, unless `limits` holds
    `value`."""
    if limits.holds(value):
        return
    place = f"{where}: " if where else ""
    raise LimitError(
        f"{place}{what} {value:g} {limits.unit} is outside {limits.low:g} to {limits.high:g} "
        f"{limits.unit} of the {limits.limited_by}",
        "choose a value inside, or correct the bench file if the limit is wrong",
    )

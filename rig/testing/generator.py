"""Checks a driver of the role `generator` step by step: what an experiment asks of it, and what the
instrument must then show."""

from __future__ import annotations

from typing import Any

from rig.instruments.interfaces import INTERFACES
from rig.testing.script import Role, Step, near, rest, same


def _sine(frequency_Hz: float, amplitude_V: float) -> Step:
    def act(generator: Any, service: Any) -> None:
        generator.sine(frequency_Hz, amplitude_V)
        near("the frequency", service.truth("frequency"), frequency_Hz, 1e-6 * frequency_Hz, "Hz")
        near("the peak amplitude", service.truth("amplitude"), amplitude_V, 1e-5 * amplitude_V, "V")

    return Step(f"sine({frequency_Hz:g}, {amplitude_V:g})", act)


def _output(on: bool) -> Step:
    def act(generator: Any, service: Any) -> None:
        generator.output(on)
        same("the output", service.truth("on"), on)

    return Step(f"output({on})", act)


def _ask_output(generator: Any, service: Any) -> None:
    same("output_is_on()", generator.output_is_on(), service.truth("on"))


GENERATOR = Role(
    *INTERFACES["generator"],
    (
        _sine(20, 0.5),
        _output(True),
        Step("output_is_on() while on", _ask_output),
        _sine(2000, 0.25),
        _sine(2, 1.5),
        _output(False),
        Step("output_is_on() while off", _ask_output),
        _output(True),
        Step("make_safe()", rest),
    ),
    excite=lambda generator, service: generator.output(True),
)

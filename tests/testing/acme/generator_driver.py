"""ACME WG1, a signal generator with SCPI on TCP."""

from contextlib import closing
from typing import Literal

from pydantic import Field

from drivers.shared.visa_link import VisaLink
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.core.settings import Address, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Limits

ROLES = ("generator",)


class Settings(BaseSettings):
    driver: Literal["acme-generator"] = "acme-generator"
    resource: Address[str]
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    max_amplitude_V: float = Field(gt=0, le=10)


class WG1:
    def __init__(self, settings, clock):
        self._settings = settings
        self._link = VisaLink("generator", settings.resource, settings.timeout_s, clock)
        self.identity = None

    def prepare(self):
        self.identity = self._link.identify()
        if self.identity.model != "WG1":
            raise InstrumentError(
                "generator",
                "*IDN?",
                f"{self._settings.resource} is a {self.identity.vendor} {self.identity.model}",
                "an ACME WG1 is expected; correct [generator]",
            )
        self.output(False)

    def limits(self):
        limited_by = f"generator {self.identity.model}"
        return {
            "frequency": Limits(0.1, 1e6, "Hz", limited_by),
            "amplitude": Limits(1e-3, self._settings.max_amplitude_V, "V", limited_by),
        }

    def sine(self, frequency_Hz, amplitude_V):
        answers = self._link.command(
            f"FREQ {frequency_Hz:.9G}", f"VOLT {amplitude_V:.9G}", then=("FREQ?", "VOLT?")
        )
        wanted_values = (frequency_Hz, amplitude_V)
        for word, got, wanted in zip(("FREQ", "VOLT"), answers, wanted_values, strict=True):
            self._verify(word, got, wanted)

    def output(self, on):
        (state,) = self._link.command(f"OUTP {on:d}", then=("OUTP?",))
        self._verify("OUTP", state, on)

    def output_is_on(self):
        return bool(self._link.number("OUTP?", self._link.query("OUTP?")))

    def make_safe(self):
        self._verify("OUTP", self._link.query("OUTP 0;OUTP?"), 0)

    def close(self):
        self._link.close()

    def _verify(self, word, got, wanted):
        if abs(self._link.number(word, got) - wanted) > 1e-5 * abs(wanted):
            raise InstrumentError("generator", word, f"set to {wanted:g} but is {got}", "look")


def connect(settings, clock):
    generator = WG1(settings, clock)
    try:
        generator.prepare()
    except BaseException:
        generator.close()
        raise
    return generator


def make_safe(settings):
    with closing(WG1(settings, WallClock())) as generator:
        generator.make_safe()

"""Simulated ACME AD2: two inputs of 16 bits, sampled together."""

import numpy as np

from drivers.simulated.instruments.core import DaqCore


class AD2Core(DaqCore):
    """Commands: ID?, CONF RATE RANGE RANGE, RUN, CNT?, GET FIRST COUNT (hexadecimal), STOP."""

    title, link, alike = "ACME AD2", "tcp", (b"CNT?",)
    vendor, model, serial_number, firmware = "ACME", "AD2", "SIM9", "1.4"

    def __init__(self, port, log, name="daq"):
        super().__init__(port, log, name)
        self.rate_S_s, self.ranges_V = 1000.0, (10.0, 10.0)
        self.acquisition = self.begun_us = None

    @property
    def acquiring(self):
        return self.acquisition is not None

    def channel(self, terminal):
        return f"AI{terminal - 101}"

    def bench_settings(self, where):
        return {"port": where}

    def answer(self, request, by):
        match request.decode("latin-1").split():
            case ["ID?"]:
                return f"{self.vendor} {self.model} {self.serial_number} {self.firmware}".encode()
            case ["CONF", rate, first, second]:
                self.rate_S_s, self.ranges_V = float(rate), (float(first), float(second))
            case ["RUN"]:
                self.acquisition, self.begun_us = self.port.begin_acquisition(), self.port.now_us
                self.log.log(self.name, "acquisition", "run", by)
            case ["CNT?"]:
                return str(self._taken()).encode()
            case ["GET", first, count] if self.acquiring:
                return self._samples(int(first), int(count))
            case ["STOP"]:
                self.acquisition = None
                self.log.log(self.name, "acquisition", "stop", by)
            case _:
                return b"WHAT"
        return b"OK"

    def _taken(self):
        if not self.acquiring:
            return 0
        return int((self.port.now_us - self.begun_us) * 1e-6 * self.rate_S_s + 1e-6)

    def _samples(self, first, count):
        rate, start = self.rate_S_s, self.begun_us
        acquisition, skew = self.acquisition, (0.0, 0.0)
        volts = self.port.volts(acquisition, (101, 102), start, rate, first, count, skew)
        counts = np.clip(np.rint(volts / self.ranges_V * 32767), -32768, 32767)
        return counts.astype("<i2").tobytes().hex().encode()

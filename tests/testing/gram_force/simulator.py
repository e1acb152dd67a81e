"""Simulated GF-ONE."""

import numpy as np

from drivers.simulated.instruments.core import host_and_port
from drivers.simulated.instruments.force_sensor import Exchange, ForceSensorCore

PERIOD_US = 2500
GRAM_FORCE_N = 0.00980665


class GfOneCore(ForceSensorCore):
    """One GF-ONE in a World."""

    title, link, axes, rates = "GF-ONE", "tcp", "z", (400.0,)
    vendor, model, serial_number, firmware = "GF", "ONE", "S77", "3.1"
    streaming, rate = False, 400.0
    matrix = tuple(tuple(GRAM_FORCE_N * v for v in row) for row in np.eye(3).tolist())

    def __init__(self, port, log, name="force_sensor"):
        self._port, self._log, self._name = port, log, name
        self._input, self._begun_us, self._sent = b"", 0, 0

    def bench_settings(self, where):
        host, port = host_and_port(where)
        return {"host": host, "tcp_port": port, "max_force_N": 40.0}

    def exchanges(self, data, by):
        *requests, self._input = (self._input + data).split(b"\r\n")
        for request in requests:
            if request == b"ID?":
                reply = (
                    f"{self.vendor}-{self.model},{self.serial_number},{self.firmware}\r\n".encode()
                )
            elif request in (b"START", b"STOP"):
                self.streaming = request == b"START"
                self._begun_us, self._sent = self._port.now_us, 0
                self._log.log(self._name, "streaming", self.streaming, by)
                reply = b"OK\r\n"
            else:
                reply = b"ERR\r\n"
            yield Exchange(request, reply)

    def frames_until(self, now_us):
        due = (now_us - self._begun_us) // PERIOD_US if self.streaming else self._sent
        numbers = np.arange(self._sent, due)
        self._sent = max(due, self._sent)
        if not len(numbers):
            return b""
        z_N = self._port.force_N((self._begun_us + PERIOD_US * (numbers + 1)) * 1e-6)[:, 2]
        key = self._port.noise_key
        noise = [np.random.default_rng([*key, int(n)]).normal(0, 0.2) for n in numbers]
        z_gf = np.clip(z_N / GRAM_FORCE_N + noise, -5000.0, 5000.0)
        return b"".join(
            b"#%04d,%+09.2f\r\n" % (n % 10000, f) for n, f in zip(numbers, z_gf, strict=True)
        )

"""Simulated TF-3."""

import numpy as np

from drivers.simulated.instruments.force_sensor import Exchange, ForceSensorCore


class TripleForceCore(ForceSensorCore):
    """One TF-3 in a World."""

    title, link, axes, rates = "TF-3", "serial", "xyz", (50.0, 100.0, 200.0)
    vendor, model, serial_number, firmware = "TF", "3", "SIM8", "3.1"
    streaming, rate = False, 50.0
    matrix = tuple(tuple(1e-3 * v for v in row) for row in np.eye(3).tolist())

    def __init__(self, port, log, name="force_sensor"):
        self._port, self._log, self._name = port, log, name
        self._input, self._begun_us, self._sent = b"", 0, 0

    def bench_settings(self, where):
        return {"port": where, "max_force_N": 40.0}

    def exchanges(self, data, by):
        *requests, self._input = (self._input + data).split(b"\n")
        for request in requests:
            reply = b"OK\n"
            if request == b"ID?":
                identity = f"{self.vendor}-{self.model},{self.serial_number},{self.firmware}\n"
                reply = identity.encode()
            elif request in (b"START", b"STOP"):
                self.streaming = request == b"START"
                self._begun_us, self._sent = self._port.now_us, 0
                self._log.log(self._name, "streaming", self.streaming, by)
            elif request.startswith(b"RATE "):
                self.rate = float(request[5:])
            else:
                reply = b"ERR\n"
            yield Exchange(request, reply)

    def frames_until(self, now_us):
        period_us = 1e6 / self.rate
        due = int((now_us - self._begun_us) / period_us) if self.streaming else self._sent
        numbers = np.arange(self._sent, due)
        self._sent = max(due, self._sent)
        if not len(numbers):
            return b""
        forces_mN = 1e3 * self._port.force_N((self._begun_us + period_us * (numbers + 1)) * 1e-6)
        key = self._port.noise_key
        lines = []
        for number, force in zip(numbers, forces_mN, strict=True):
            noise = np.random.default_rng([*key, int(number)]).normal(0, 1.0, 3)
            lines.append(b"%.2f;%.2f;%.2f\n" % tuple(force + noise))
        return b"".join(lines)

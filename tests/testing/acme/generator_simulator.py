"""Simulated ACME WG1: SCPI, one channel."""

from drivers.simulated.instruments.core import Excitation, GeneratorCore, host_and_port


class WG1Core(GeneratorCore):
    """Commands: FREQ, VOLT (peak), OUTP, each with a query; SYST:ERR?, *IDN?, *CLS."""

    title, link = "ACME WG1", "tcp"
    vendor, model, serial_number, firmware = "ACME", "WG1", "SIM42", "1.0"

    def __init__(self, port, log, name="generator"):
        super().__init__(port, log, name)
        self.values = {"FREQ": 1000.0, "VOLT": 0.1, "OUTP": 0.0}

    def bench_settings(self, where):
        host, port = host_and_port(where)
        return {"resource": f"TCPIP::{host}::{port}::SOCKET", "max_amplitude_V": 10.0}

    def answer(self, request, by):
        answers = []
        for command in request.decode("latin-1").split(";"):
            word, _, value = command.strip().lstrip(":").partition(" ")
            if word == "*IDN?":
                one = ",".join((self.vendor, self.model, self.serial_number, self.firmware))
                answers.append(one)
            elif word == "SYST:ERR?":
                answers.append('+0,"No error"')
            elif word.endswith("?"):
                answers.append(f"{self.values[word[:-1]]:.9G}")
            elif word in self.values:
                self.values[word] = float(value)
                self.log.log(self.name, word, float(value), by)
                frequency, volts, on = self.values.values()
                self.port.excite(1, Excitation(bool(on), "SIN", frequency, volts, 0.0, 0.0), by)
        return ";".join(answers).encode() if answers else None

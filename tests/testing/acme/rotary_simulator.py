"""Simulated ACME R30, a rotary stage on a serial line."""

from drivers.simulated.instruments.core import RotaryStageCore


class R30Core(RotaryStageCore):
    """Answers every command with one line."""

    title, link, alike = "ACME R30", "serial", (b"ST?", b"TURN")
    vendor, model, serial_number, firmware = "ACME", "R30", "SIM3", "0.9"

    def bench_settings(self, where):
        low, high = self.limits
        return {"port": where, "low_limit_deg": low, "high_limit_deg": high}

    def answer(self, request, by):
        self.settle(self.port.now_us)
        match request.decode("latin-1").split():
            case ["ID?"]:
                return f"{self.vendor} {self.model} {self.serial_number} {self.firmware}".encode()
            case ["ST?"]:
                state = "FAIL" if self.failure else "MOVE" if self.moving else "IDLE"
                return f"{state} {int(self.homed)} {self.position:.5f}".encode()
            case ["TURN", target, speed, acceleration]:
                if not self.homed or self.failure:
                    return b"NO"
                self.move(float(target), float(speed), float(acceleration), by)
            case ["HOME"]:
                self.recover()
                self.home(20.0, 500.0, by)
            case ["STOP"]:
                self.stop(500.0, by)
            case _:
                return b"WHAT"
        return b"OK"

"""Simulated ACME Z50."""

from drivers.simulated.instruments.core import LinearStageCore

LIMITS = {"max_speed_mm_s": 20.0, "torque_limit_percent": 25.0}
PEAK_N = 100.0


class Z50Core(LinearStageCore):
    """A linear stage; answers every command with one line."""

    title, link, alike = "ACME Z50", "tcp", (b"ST?",)
    vendor, model, serial_number, firmware = "ACME", "Z50", "SIM0007", "2.1"

    def bench_settings(self, where):
        low, high = self.limits
        return {"port": where, "low_limit_mm": low, "high_limit_mm": high, **LIMITS}

    def answer(self, request, by):
        now_us = self.port.now_us
        self.settle(now_us)
        match request.decode("latin-1").split():
            case ["ID?"]:
                return f"{self.vendor} {self.model} {self.serial_number} {self.firmware}".encode()
            case ["ST?"]:
                state = "FAIL" if self.failure else "MOVE" if self.moving else "IDLE"
                return f"{state} {int(self.homed)} {self.position:.5f}".encode()
            case ["MOVE", target, speed]:
                if not self.homed or self.failure:
                    return b"NO"
                self.move(float(target), float(speed), 500.0, by)
            case ["TORQUE", percent]:
                self.axis.force_limit_N = PEAK_N * float(percent) / 100
            case ["TORQUE?"]:
                return f"{100 * self.axis.force_limit_N / PEAK_N:.1f}".encode()
            case ["HOME"]:
                self.recover()
                self.home(10.0, 500.0, by)
            case ["STOP"]:
                self.stop(500.0, by)
            case _:
                return b"WHAT"
        return b"OK"

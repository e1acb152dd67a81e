"""TF-3: three axes in mN, 50, 100 or 200 lines/s, such as "12.5;-3.0;1200.5"; answers OK."""

import math
from typing import Literal

from drivers.shared.line_force_sensor import (
    LineForceSensor,
    LineForceSensorSettings,
    driver_members,
)


class Settings(LineForceSensorSettings):
    """Where the sensor is, and which force it may see."""

    driver: Literal["tf-3"] = "tf-3"
    baudrate: Literal[19_200, 115_200] = 115_200


class TripleForce(LineForceSensor):
    vendor, model = "TF", "3"
    axes, unit, full_scale = "xyz", "mN", 60_000.0
    rates_S_s, rate_command = (50.0, 100.0, 200.0), "RATE {rate:g}"
    terminator = b"\n"
    identify = "ID?", r"(?P<vendor>\w+)-(?P<model>\S+),(?P<serial_number>\w+),(?P<firmware>\S+)"
    start_command, stop_command, acknowledges = "START", "STOP", "OK"

    def parse(self, line):
        if line == b"OVER":
            return [math.inf] * 3
        return [float(number) for number in line.split(b";")]


ROLES, connect, make_safe = driver_members(TripleForce)

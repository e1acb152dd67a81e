"""The base of drivers for force sensors that send a line of text a frame: what becomes of lines
that are broken, late, too many or missing."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

import drivers.shared.line_link as line_link
from drivers.shared.line_force_sensor import (
    LineForceSensor,
    LineForceSensorSettings,
    driver_members,
)
from rig.core.clock import Clock
from rig.core.errors import ConfigurationError, InstrumentError, InstrumentTimeoutError
from rig.instruments.roles import ForceFrames

FRAME = re.compile(rb"[+-]\d{4}\.\d{3}")
IDENTITY = b"ACME F10 v1.2\r\n"


class F10(LineForceSensor):
    """The sensor of docs/add-a-driver.md, in mN and with a text for an overload."""

    vendor, model = "ACME", "F10"
    axes, unit, full_scale, rates_S_s = "z", "mN", 5000.0, (100.0,)
    terminator, identify = b"\r\n", ("*I", r"ACME (?P<model>\S+) v(?P<firmware>\S+)")
    start_command, stop_command, acknowledges = "*C", "*S", False

    def parse(self, line: bytes) -> float:
        if line in (b"+OL", b"-OL"):
            return math.copysign(math.inf, float(line[:1] + b"1"))
        if line == b"NAN":
            return math.nan
        found = FRAME.fullmatch(line)
        assert found is not None
        return float(found[0])


class F10Rates(F10):
    """One with three rates, whose commands are acknowledged, and x and z in a line."""

    axes, unit, newtons_per_unit, full_scale = "xz", "count", 0.01, 4000.0
    rates_S_s, rate_command, acknowledges = (10.0, 100.0, 1000.0), "RATE {rate:g}", "OK"

    def parse(self, line: bytes) -> Any:
        return [float(one) for one in line.split(b",")]


class ClockByHand(Clock):
    """A clock that is set by hand, and by time-outs."""

    time_s = 0.0

    def now(self) -> float:
        return self.time_s

    def _pass(self, seconds: float) -> None:
        self.time_s += seconds


class TalkingSensor:
    """What is at the other end of the port: answers by command, and lines of its own accord."""

    def __init__(self) -> None:
        self.answers = {b"*I": IDENTITY}
        self.sent: list[bytes] = []
        self.input = b""
        self.endless = b""
        self.piece = 1 << 20
        """Most bytes that one read gives."""

    def write(self, data: bytes) -> None:
        for command in data.split(b"\r\n")[:-1]:
            self.sent.append(command)
            self.input += self.answers.get(command, b"")

    def read(self) -> bytes:
        self.input += self.endless
        data, self.input = self.input[: self.piece], self.input[self.piece :]
        return data

    def close(self) -> None:
        self.input = b""


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> TalkingSensor:
    made = TalkingSensor()
    monkeypatch.setattr(line_link, "open_port", lambda *given: made)
    return made


def connected(
    kind: type[LineForceSensor] = F10, clock: Clock | None = None, place: str = "/dev/ttyUSB0"
) -> LineForceSensor:
    settings = LineForceSensorSettings(port=place, timeout_s=0.3, max_force_N=4.0)
    return kind.connect(settings, clock or ClockByHand())


def frames(sensor: LineForceSensor) -> ForceFrames:
    found = sensor.read()
    assert found is not None
    return found


def test_lines_in_bursts_and_in_pieces_are_numbered_from_the_start_of_each_stream(
    port: TalkingSensor,
) -> None:
    sensor = connected()
    for _ in range(2):
        assert sensor.start(70.0) == 100.0
        assert sensor.read() is None
        port.input = b"+0001.000\r\n+0002.000\r\n-0003.000\r\n+00"
        burst = frames(sensor)
        assert (burst.first_index, burst.raw_unit) == (0, "mN")
        assert burst.raw.tolist() == [[0, 0, 1], [0, 0, 2], [0, 0, -3]]
        assert burst.force_N[:, 2] == pytest.approx([1e-3, 2e-3, -3e-3])
        port.input = b"04.000\r"
        assert sensor.read() is None
        port.input = b"\n"
        assert (frames(sensor).first_index, sensor.bytes_consumed > 0) == (3, True)
    sensor.close()


def test_frames_that_come_before_the_answer_to_the_start_belong_to_the_stream(
    port: TalkingSensor,
) -> None:
    sensor = connected()
    port.answers[b"*C"] = b"+0001.000\r\n"
    sensor.start(100.0)
    assert frames(sensor).raw[:, 2].tolist() == [1.0]


def test_half_a_line_of_a_stream_that_was_running_is_neither_an_error_nor_a_frame(
    port: TalkingSensor,
) -> None:
    port.piece = 7
    port.input = b"2.345\r\n+0001.000\r\n"
    sensor = connected()
    assert sensor.identity.firmware == "1.2"
    sensor.start(100.0)
    port.piece = 100
    port.input = b"+0007.000\r\n+0008"
    assert frames(sensor).raw[:, 2].tolist() == [7.0]
    port.answers[b"*S"] = b".000\r\n+0009.000\r\n"
    sensor.stop()
    port.answers[b"*S"] = b""
    sensor.start(100.0)
    port.input = b"+0002.000\r\n"
    again = frames(sensor)
    assert (again.first_index, again.raw[:, 2].tolist()) == (0, [2.0])


@pytest.mark.parametrize(
    ("line", "why"),
    [(b"+0012.3x5", "AssertionError"), (b"", "AssertionError"), (b"NAN", "not a number")],
)
def test_a_line_that_is_not_a_frame_ends_the_stream_until_it_is_started_again(
    port: TalkingSensor, line: bytes, why: str
) -> None:
    sensor = connected()
    sensor.start(100.0)
    port.input = b"+0001.000\r\n" + line + b"\r\n+0002.000\r\n"
    with pytest.raises(InstrumentError) as first:
        sensor.read()
    said = first.value.one_line()
    for words in (
        *("force_sensor", "stream", repr(line), "not a frame of the F10", why),
        *("/dev/ttyUSB0", "baudrate (9600) and serial_format (8N1) of [force_sensor] in the bench"),
        f"if the line is sound, correct parse() in {__name__}",
    ):
        assert words in said
    with pytest.raises(InstrumentError) as second:
        sensor.read()
    assert second.value is first.value
    sensor.start(100.0)
    assert sensor.read() is None


def test_over_tcp_nothing_is_said_of_a_serial_port(port: TalkingSensor) -> None:
    sensor = connected(place="socket://192.168.0.40:4000")
    sensor.start(100.0)
    port.input = b"+0001\r\n"
    with pytest.raises(InstrumentError) as failed:
        sensor.read()
    assert "that nothing else talks to socket://192.168.0.40:4000; if the" in failed.value.hint
    assert "baudrate" not in failed.value.hint


def test_a_line_with_too_few_values_is_an_error(port: TalkingSensor) -> None:
    port.answers.update(dict.fromkeys((b"*C", b"*S", b"RATE 100"), b"OK\r\n"))
    sensor = connected(F10Rates)
    assert sensor.start(130.0) == 100.0
    assert port.sent[-2:] == [b"RATE 100", b"*C"]
    port.input = b"100,-200\r\n"
    assert frames(sensor).force_N.tolist() == [[1.0, 0.0, -2.0]]
    port.input = b"100\r\n"
    with pytest.raises(InstrumentError, match=r"parse\(\) returned 1 value, not 2"):
        sensor.read()


def test_an_overload_is_a_saturated_frame_at_full_scale(port: TalkingSensor) -> None:
    sensor = connected()
    sensor.start(100.0)
    port.input = b"+0001.000\r\n+OL\r\n-OL\r\n+5000.000\r\n+5000.500\r\n"
    found = frames(sensor)
    assert found.saturated.tolist() == [False, True, True, True, True]
    assert found.raw[:, 2].tolist() == [1.0, 5000.0, -5000.0, 5000.0, 5000.5]


def test_a_sensor_that_sends_nothing_after_the_start_falls_behind(port: TalkingSensor) -> None:
    clock = ClockByHand()
    sensor = connected(F10, clock)
    sensor.start(100.0)
    clock.time_s += 0.5
    assert sensor.read() is None
    assert sensor.frames_behind == pytest.approx(50.0)
    sensor.stop()
    assert sensor.frames_behind == 0.0


def test_a_stream_that_a_stop_does_not_end_is_an_error(port: TalkingSensor) -> None:
    sensor = connected()
    sensor.start(100.0)
    port.endless = b"+0001.000\r\n"
    with pytest.raises(InstrumentError, match=r"the instrument continues to send: .*0001\.000"):
        sensor.stop()


def test_a_sensor_that_never_falls_silent_is_refused_when_it_is_connected(
    port: TalkingSensor,
) -> None:
    port.endless = b"+0001.000\r\n"
    with pytest.raises(InstrumentError, match="the instrument continues to send"):
        connected()


def test_a_missing_answer_is_a_time_out_that_shows_what_came_instead(port: TalkingSensor) -> None:
    port.answers.update(dict.fromkeys((b"*C", b"*S", b"RATE 100"), b"OK\r\n"))
    sensor = connected(F10Rates)
    port.answers[b"*C"] = b"ERR 7\r\n"
    with pytest.raises(InstrumentTimeoutError) as refused:
        sensor.start(100.0)
    assert "*C" in refused.value.message
    assert "the last line that came is 'ERR 7'" in refused.value.message
    port.answers[b"*C"] = b""
    with pytest.raises(InstrumentTimeoutError, match=r"no answer within 0\.3 s") as silent:
        sensor.start(100.0)
    assert "/dev/ttyUSB0" in str(silent.value.hint)


def test_a_sensor_that_is_silent_or_garbled_at_connect_may_have_another_baud_rate(
    port: TalkingSensor,
) -> None:
    checks = "that the instrument has the baud rate of this link, 9600, and its format, 8N1"
    for answer in (b"", b"\xf0\x89", b"\xf0\x89\r\n"):
        port.answers[b"*I"] = answer
        with pytest.raises(InstrumentError) as failed:
            connected()
        assert checks in str(failed.value.hint)
    settings = LineForceSensorSettings(port="socket://h:1", timeout_s=0.1, max_force_N=4.0)
    with pytest.raises(InstrumentError) as failed:
        F10.connect(settings, ClockByHand())
    assert "baud" not in failed.value.one_line()


def test_a_sensor_that_echoes_commands_is_refused_with_that_reason(port: TalkingSensor) -> None:
    echoed = r"is (not a frame but )?the command itself: it is echoed"
    port.answers.update({one: one + b"\r\n" for one in (b"*I", b"*S")})
    with pytest.raises(InstrumentError, match=echoed) as at_connect:
        connected()
    assert "switch off the echo" in str(at_connect.value.hint)
    port.answers.update({b"*I": IDENTITY, b"*C": b"*C\r\n"})
    sensor = connected()
    sensor.start(100.0)
    with pytest.raises(InstrumentError, match=echoed) as streaming:
        sensor.read()
    assert "switch off the echo" in str(streaming.value.hint)
    port.answers.update({b"*S": b"", b"*I": b"*I\r\n"})
    with pytest.raises(InstrumentTimeoutError, match="'\\*I', the command itself: it is echoed"):
        sensor.stop()


def test_a_command_that_is_not_acknowledged_is_named_on_one_line(port: TalkingSensor) -> None:
    sensor = connected()
    port.answers.clear()
    with pytest.raises(InstrumentTimeoutError) as silent:
        sensor.stop()
    assert silent.value.message.startswith("force_sensor: *S, *I")
    assert len(silent.value.message.splitlines()) == 1


def test_a_stream_can_begin_again_after_a_stop_without_an_answer(port: TalkingSensor) -> None:
    """The reader of a run reads before it has begun: the port is closed until the start."""
    sensor = connected()
    sensor.start(100.0)
    port.answers[b"*I"] = b""
    with pytest.raises(InstrumentTimeoutError):
        sensor.stop()
    assert sensor.read() is None
    port.answers[b"*I"] = IDENTITY
    sensor.start(100.0)
    port.input = b"+0002.000\r\n"
    assert frames(sensor).raw[:, 2].tolist() == [2.0]


def test_another_instrument_is_refused(port: TalkingSensor) -> None:
    port.answers[b"*I"] = b"ACME T-1000 v1\r\n"
    with pytest.raises(InstrumentError) as refused:
        connected()
    assert (
        "the sensor at /dev/ttyUSB0 is the ACME T-1000; the ACME F10 is expected; correct "
        "[force_sensor] in the bench file"
    ) in refused.value.one_line()


def test_making_safe_sends_nothing_and_leaves_the_stream(port: TalkingSensor) -> None:
    _, connect, make_safe = driver_members(F10)
    settings = LineForceSensorSettings(port="/dev/ttyUSB0", timeout_s=0.3, max_force_N=4.0)
    sensor = connect(settings, ClockByHand())
    sensor.start(100.0)
    said = list(port.sent)
    sensor.make_safe()
    make_safe(settings)
    assert port.sent == said
    port.input = b"+0001.000\r\n"
    assert len(frames(sensor)) == 1


def test_a_force_beyond_full_scale_is_refused_before_anything_is_sent(port: TalkingSensor) -> None:
    settings = LineForceSensorSettings(port="/dev/ttyUSB0", max_force_N=6.0)
    with pytest.raises(ConfigurationError) as refused:
        F10.connect(settings, ClockByHand())
    assert "max_force_N = 6 is beyond the 5 N that the ACME F10 measures" in refused.value.message
    assert refused.value.hint == "lower max_force_N of [force_sensor] in the bench file"
    assert not port.sent


def test_baudrate_and_serial_format_reach_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[dict[str, Any]] = []

    def serial(path: str, baudrate: int, **given: Any) -> Any:
        opened.append({"path": path, "baudrate": baudrate, **given})
        raise OSError("there is no such port")

    monkeypatch.setattr("serial.Serial", serial)
    settings = LineForceSensorSettings(
        port="/dev/ttyUSB7", baudrate=19_200, serial_format="7E1", max_force_N=4.0
    )
    with pytest.raises(InstrumentError, match="there is no such port"):
        F10.connect(settings, ClockByHand())
    (given,) = opened
    assert (given["path"], given["baudrate"]) == ("/dev/ttyUSB7", 19_200)
    assert (given["bytesize"], given["parity"], given["stopbits"]) == (7, "E", 1)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"unit": "g"}, "has the unit 'g'; known are N, mN, kN, gf"),
        ({"axes": "zx"}, "has axes = 'zx'"),
        ({"rates_S_s": (10.0, 100.0)}, "a rate_command"),
        ({"rates_S_s": ()}, "needs one rate"),
        ({"rates_S_s": (0.0,)}, "above 0"),
        ({"full_scale": -1.0}, "above 0"),
        ({"terminator": b""}, "a terminator"),
    ],
)
def test_a_class_that_no_sensor_can_have_is_refused_with_the_reason(
    members: dict[str, Any], words: str
) -> None:
    with pytest.raises(TypeError, match=re.escape(words)):
        type("Wrong", (F10,), members)


def test_a_class_that_lacks_something_is_refused_with_all_that_it_lacks() -> None:
    with pytest.raises(TypeError, match="Bare lacks vendor, model, axes, unit, full_scale, rates"):
        type("Bare", (LineForceSensor,), {"parse": lambda self, line: 0.0})

"""Bench files, fault plans, World settings and calibration records from strangers: refused in a
sentence, soon, whatever is in them."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.world.settings import read_world
from rig.bench.plan import parse_bench, read_bench
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.toml_files import MAX_TOML_BYTES, MAX_TOML_LINE
from rig.instruments.calibration import (
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    read_calibration,
)

READERS: dict[str, Callable[[Path], object]] = {
    "bench": read_bench,
    "fault plan": FaultPlan.read,
    "World": lambda path: read_world(str(path)),
    "film": lambda path: read_calibration(path, FilmCalibration),
    "force": lambda path: read_calibration(path, ForceCalibration),
    "load cell": lambda path: read_calibration(path, LoadCellCalibration),
}
TOML = ("bench", "fault plan", "World")
LONGEST_SENTENCE = 4000


def refusal(read: Callable[[Path], object], path: Path) -> str:
    """The sentence that refuses a file; empty where it was taken."""
    try:
        read(path)
    except RigError as error:
        assert error.code is ExitCode.USAGE  # noqa: PT017 - it may be taken, too
        return error.one_line()
    return ""


def check_refused(read: Callable[[Path], object], path: Path) -> str:
    line = refusal(read, path)
    assert path.name in line
    assert len(line) < LONGEST_SENTENCE
    return line


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "make",
    [
        lambda path: None,
        lambda path: path.mkdir(),
        os.mkfifo,
        lambda path: path.symlink_to("/dev/zero"),
        lambda path: path.symlink_to(path),
        lambda path: path.write_bytes(b"\xff\xfe"),
        lambda path: path.write_bytes(b"\0" * 100),
        lambda path: (path.touch(), os.truncate(path, 1 << 40)),
    ],
    ids=["missing", "folder", "pipe", "device", "loop", "not text", "zeros", "a terabyte"],
)
def test_what_is_no_settings_file_is_refused(
    tmp_path: Path, reader: str, make: Callable[[Path], object]
) -> None:
    make(tmp_path / "given")
    check_refused(READERS[reader], tmp_path / "given")


SIZE = MAX_TOML_BYTES - 100
LINE = MAX_TOML_LINE - 100


@pytest.mark.parametrize("reader", TOML)
@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 4000,
        "a = " + "[" * 4000 + "]" * 4000,
        "a = " + "{ a = " * 1000 + "1" + " }" * 1000,
        ".".join("a" * (LINE // 2)) + " = 1",
        "[" + ".".join("a" * 40) + "]",
        "a = " + "9" * 5000,
        "a = 1e999999",
        'a = "\\ud800"',
        "a = " + "1" * MAX_TOML_LINE,
        "#" * MAX_TOML_BYTES + "\n#",
        "".join(f"k{k} = 1\n" for k in range(SIZE // 12)),
        "x" * 5000 + " = 1",
        'a = "\\u001b[2J"\n"\\u001b[2J" = 1',
    ],
    ids=[
        *("open lists", "deep lists", "deep tables", "a long name", "a long header"),
        *("a long integer", "a large float", "a surrogate", "a long line", "a long file"),
        *("thousands of keys", "a key of 5000 letters", "terminal codes"),
    ],
)
def test_toml_beyond_sense_is_refused(tmp_path: Path, reader: str, text: str) -> None:
    path = tmp_path / "given.toml"
    path.write_text(text)
    check_refused(READERS[reader], path)


@pytest.mark.parametrize("reader", sorted(set(READERS) - set(TOML)))
@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a":' * 900 + "1" + "}" * 900,
        '{"kind": "film", "sensor": ' + "9" * 5000 + "}",
        json.dumps({"kind": "pvdf"} | {f"k{k}": 1 for k in range(9000)}),
        json.dumps({"kind": "force"} | {f"k{k}": 1 for k in range(9000)}),
        json.dumps({"kind": "load-cell"} | {f"k{k}": 1 for k in range(9000)}),
        json.dumps({"kind": "pvdf", "sensor": "\0" * 500_000}),
        " " * (1 << 21),
    ],
)
def test_json_beyond_sense_is_refused(tmp_path: Path, reader: str, text: str) -> None:
    path = tmp_path / "given.json"
    path.write_text(text)
    check_refused(READERS[reader], path)


BENCH = """
name = "bench-3"
heartbeat_timeout_s = 7
[fixture]
mounted = "film-clamp"
parked_mm = 5.0
[film]
name = "batch 12"
[load_cell]
sensitivity_V_N = 0.5
[calibrations]
film = "calibrations/film.json"
expiry_warning_days = 14
[simulation]
seed = 3
[generator]
driver = "keysight-33500b"
resource = "TCPIP::127.0.0.1::1::SOCKET"
max_amplitude_V = 2.0
[daq]
driver = "keysight-u2300a"
resource = "TCPIP::127.0.0.1::hislip0,1::INSTR"
channels = { load_cell = 101, film = 102 }
[stage_z]
driver = "festo-cmmt"
axis = "z"
host = "127.0.0.1"
low_limit_mm = 0.0
high_limit_mm = 14.0
max_speed_mm_s = 20.0
torque_limit_percent = 45.0
[force_sensor]
driver = "me-gsv8"
port = "/dev/ttyACM0"
nominal_force_N = 50.0
max_force_N = 40.0
matrix_N_mV_V = [[80.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 80.0]]
"""
FAULTS = """[[fault]]
device = "daq"
kind = "silence"
at = 3
count = 1
command = "WAV"
[[fault]]
device = "stage_z"
kind = "drive-fault"
move = 2
code = 126
[[fault]]
device = "force_sensor"
kind = "spike"
acquisition = 1
force_N = 3.0
[[fault]]
device = "disk"
kind = "slow-sync"
delay_s = 0.5
"""
WORLD = 'film = "drawn"\nfilm_gain = 2.0\nforce_sensor_zero_mV_V = [ 0.1, 0.0, -0.1 ]\n'
GOOD = {"bench": BENCH, "fault plan": FAULTS, "World": WORLD}

TOML_VALUES = st.sampled_from(
    [
        *("0", "-1", "1e308", "-1e308", "5e-324", "nan", "inf", "-inf", "true", '""', "[]", "{}"),
        *("9223372036854775807", "9" * 400, "[[]]", "[1, 'a']", "{ a = { a = 1 } }", "''"),
        *('"../../../etc/passwd"', '"/etc/passwd"', '"a\\u0000b"', '"\\u001b[31m"', "1979-05-27"),
        *('"' + "x" * 5000 + '"', '"os.system"', '"rig.cli"', '"simulated"', "[" * 20 + "]" * 20),
    ]
)


@st.composite
def spoiled(draw: st.DrawFn, text: str) -> str:
    """The TOML text with some of its values or lines replaced, repeated, or cut short."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        number = draw(st.integers(0, len(lines) - 1))
        key, equals, _ = lines[number].partition(" = ")
        act = draw(st.sampled_from(["value", "value", "value", "repeat", "drop", "cut"]))
        if act == "value" and equals:
            lines[number] = f"{key} = {draw(TOML_VALUES)}"
        elif act == "repeat":
            lines.insert(draw(st.integers(0, len(lines))), lines[number])
        elif act == "drop":
            lines[number] = ""
        else:
            lines[number] = lines[number][: draw(st.integers(0, len(lines[number])))]
    return "\n".join(lines)


@pytest.mark.parametrize("reader", TOML)
@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_spoiled_file_is_taken_or_refused_in_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, reader: str, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "spoiled.toml"
    text = data.draw(spoiled(GOOD[reader]))
    path.write_text(text)
    line = refusal(READERS[reader], path)
    if not line:
        tomllib.loads(text)  # what is no TOML is never taken
    assert "\n" not in line
    assert len(line) < LONGEST_SENTENCE


@pytest.mark.parametrize("reader", GOOD)
def test_the_unspoiled_files_are_taken(tmp_path: Path, reader: str) -> None:
    path = tmp_path / "good.toml"
    path.write_text(GOOD[reader])
    assert refusal(READERS[reader], path) == ""


@pytest.mark.parametrize("name", ["../bench", "/tmp/bench", "a/b", ".", "..", "a\\u0000b", "-x"])
def test_a_bench_cannot_name_a_place_outside_the_results(name: str) -> None:
    """The guard's report bears the bench's name."""
    with pytest.raises(ConfigurationError, match="name"):
        parse_bench(BENCH.replace("bench-3", name), "bench.toml")


@pytest.mark.parametrize("driver", ["os", "../x", "drivers.simulated.bench.start", "rig.cli", ""])
def test_a_bench_file_cannot_have_just_any_module_imported(driver: str) -> None:
    with pytest.raises(ConfigurationError, match="is unknown"):
        parse_bench(BENCH.replace("keysight-33500b", driver), "bench.toml")


def test_many_errors_are_counted_not_listed(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="and 80 more"):
        parse_bench("".join(f"key_{k} = 1\n" for k in range(100)) + BENCH, "bench.toml")


def test_terminal_codes_in_a_file_reach_the_terminal_as_text(rig: Any) -> None:
    (rig.folder / "bench.toml").write_text('"\\u001b[2J" = 1\n')
    ended = rig.run("sweep", "--bench", "bench.toml")
    assert ended.code == 2
    assert "\x1b" not in ended.stderr
    assert "\\x1b[2J: unknown key" in ended.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("sweep", "--bench", "given"),
        ("make-safe", "--bench", "given"),
        ("sweep", "--world", "given"),
        ("simulate", "--fault", "given"),
    ],
)
def test_the_command_line_tells_it_in_one_line(rig: Any, arguments: tuple[str, ...]) -> None:
    (rig.folder / "given").write_text("a = " + "[" * 4000)
    ended = rig.run(*arguments)
    assert ended.code == 2
    (error,) = ended.errors
    assert "given: nested deeper than 32" in error
    assert "Traceback" not in ended.stderr

"""Bench files: everything wrong is reported at once; what is connected refuses what is outside."""

from __future__ import annotations

import re
import textwrap
import threading
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.limits import GuardedGenerator, require
from rig.bench.link_worker import LinkWorkers
from rig.bench.plan import BenchPlan, InstrumentPlan, parse_bench, read_bench, rehearsal
from rig.core.clock import WallClock
from rig.core.errors import ConfigurationError, ExitCode, InstrumentError, LimitError, RigError
from rig.instruments.roles import Identity, Limits
from rig.run.points import Move, Point, require_roles

GOOD = """
name = "bench-3"
heartbeat_timeout_s = 7

[fixture]
mounted = "film-clamp"

[film]
name = "batch 12"

[load_cell]
sensitivity_V_N = 0.5
max_load_N = 12.0

[generator]
driver = "keysight-33500b"
resource = "TCPIP::192.168.0.12::5025::SOCKET"
max_amplitude_V = 2.0

[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW1::INSTR"
channels = { load_cell = 101, film = 103 }
"""


def refused(text: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        parse_bench(text, "bench.toml")
    assert "\n" not in caught.value.one_line()
    assert caught.value.code == ExitCode.USAGE
    return caught.value.one_line()


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new)


BENCH_FILE_PAGE = Path(__file__).parents[2] / "docs" / "bench-file.md"


def examples() -> dict[str, str]:
    """The bench files of docs/bench-file.md, by what is mounted."""
    blocks = re.findall(
        r"(?:^(?: {4}.*)?\n)+", BENCH_FILE_PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    found = [textwrap.dedent(block) for block in blocks if "[fixture]" in block]
    return {tomllib.loads(text)["fixture"]["mounted"]: text for text in found}


@pytest.mark.parametrize(
    ("fixture", "roles"),
    [
        ("film-clamp", {"generator", "daq", "stage_z", "force_sensor"}),
        ("plate", {"daq", "stage_z", "stage_x", "force_sensor"}),
    ],
)
def test_the_documented_bench_files_have_all_that_their_procedure_needs(
    fixture: str, roles: set[str]
) -> None:
    plan = parse_bench(examples()[fixture], "bench-file.md")
    assert {part.role for part in plan.instruments} == roles
    assert plan.settings.fixture.contact_from_mm is not None
    assert plan.settings.fixture.contact_to_mm is not None
    part = plan.settings.film if fixture == "film-clamp" else plan.settings.skin
    assert part is not None


# --- the file --------------------------------------------------------------------------------


def test_a_good_file_becomes_a_plan() -> None:
    plan = parse_bench(GOOD, "bench.toml")
    assert plan.settings.name == "bench-3"
    assert plan.settings.load_cell is not None
    assert plan.settings.load_cell.max_load_N == 12.0
    assert [part.role for part in plan.instruments] == ["generator", "daq"]
    assert plan.text == GOOD


WRONG: dict[str, tuple[str, str]] = {
    "unknown key": (changed("name = ", "nmae = 1\nname = "), "nmae: unknown key"),
    "unknown key of a part": (changed("sensitivity_V_N", "gain = 1\nsensitivity_V_N"), "gain"),
    "unknown key of a driver": (changed("max_amplitude_V", "loud = 1\nmax_amplitude_V"), "loud"),
    "a name with a blank": (
        changed("bench-3", "bench 3"),
        "name = 'bench 3': must consist of letters without accents, digits, '_', '.' and '-'",
    ),
    "unknown table": (GOOD + "\n[oven]\nx = 1\n", "oven: unknown key"),
    "unknown driver": (
        changed("keysight-33500b", "keysight-1"),
        "choose a driver among festo-cmmt, keysight-33500b",
    ),
    "driver of another role": (
        changed("keysight-33500b", "keysight-u2300a"),
        "driver 'keysight-u2300a' is for the role daq",
    ),
    "no driver": (changed('driver = "keysight-33500b"\n', ""), "[generator]: names no driver"),
    "a role that is no table": (
        GOOD.split("[daq]")[0].replace('name = "bench-3"', 'name = "b"\ndaq = 3'),
        "[daq]: names no driver",
    ),
    "missing setting": (changed("max_amplitude_V = 2.0\n", ""), "max_amplitude_V: missing"),
    "limit beyond the instrument": (changed("= 2.0", "= 200.0"), "max_amplitude_V = 200.0"),
    "not a number": (changed("= 0.5", '= "half"'), "load_cell.sensitivity_V_N = 'half'"),
    "not finite": (changed("= 0.5", "= nan"), "load_cell.sensitivity_V_N"),
    "fixture that does not exist": (changed("film-clamp", "vice"), "fixture.mounted = 'vice'"),
    "no fixture": (changed('[fixture]\nmounted = "film-clamp"\n', ""), "fixture: missing"),
    "name that is no file name": (changed("bench-3", "../bench"), "name = '../bench'"),
    "a part that is not wired": (
        changed("film = 103", "spare = 103"),
        "[film] is described, but [daq.channels] wires no film",
    ),
    "a part without a DAQ": (GOOD.split("[daq]")[0], "wires no load_cell"),
    "two signals on one terminal": (changed("film = 103", "film = 101"), "one terminal"),
    "syntax": (changed("[film]", "[film"), "correct the TOML syntax"),
    "a key twice": (changed("max_load_N = 12.0", "max_load_N = 1\nmax_load_N = 2"), "bench.toml"),
    "empty": ("", "name: missing"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_place_and_reason(case: str) -> None:
    text, reported = WRONG[case]
    message = refused(text)
    assert "bench.toml" in message
    assert reported in message, message


def test_all_errors_are_reported_at_once() -> None:
    text = changed("film-clamp", "vice").replace("= 2.0", "= 200.0").replace("= 101", "= 1")
    message = refused(text)
    for reported in ("fixture.mounted", "max_amplitude_V", "load_cell = 1 is not a terminal"):
        assert reported in message


def test_a_daq_that_is_wrong_itself_is_not_blamed_for_its_wiring() -> None:
    message = refused(changed("channels = {", "channel = {"))
    assert "channel: unknown key" in message
    assert "wires no" not in message


@pytest.mark.parametrize(
    "make",
    [
        lambda path: None,
        lambda path: path.mkdir(),
        lambda path: path.write_bytes(b"name = \xff"),
        lambda path: path.write_text("name = "),
    ],
    ids=["missing", "a folder", "not text", "not TOML"],
)
def test_a_file_that_cannot_be_read_is_reported_by_name(tmp_path: Path, make: Any) -> None:
    path = tmp_path / "bench.toml"
    make(path)
    with pytest.raises(ConfigurationError, match=r"bench\.toml"):
        read_bench(path)


# --- connected -------------------------------------------------------------------------------


class Fake:
    """An instrument that remembers what was asked of it."""

    def __init__(self, serial: str = "MY1"):
        self.identity = Identity("ACME", "G", serial, "1")
        self.calls: list[tuple[object, ...]] = []

    def limits(self) -> dict[str, Limits]:
        return {
            "frequency": Limits(1.0, 1000.0, "Hz", "generator G"),
            "amplitude": Limits(0.1, 2.0, "V", "generator G"),
        }

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: self.calls.append((name, *arguments))


def plan_with(*drivers: Any) -> BenchPlan:
    """The good file's plan with other drivers behind its roles."""
    plan = parse_bench(GOOD, "bench.toml")
    parts = [
        InstrumentPlan(part.role, part.driver_name, driver, part.settings)
        for part, driver in zip(plan.instruments, drivers, strict=True)
    ]
    return replace(plan, instruments=tuple(parts))


def works(instrument: Fake) -> Any:
    return SimpleNamespace(connect=lambda settings, clock: instrument)


def fails(error: Exception) -> Any:
    def connect(settings: object, clock: object) -> Any:
        raise error

    return SimpleNamespace(connect=connect)


def test_connecting_gives_a_guarded_generator_and_the_limits_of_all() -> None:
    generator, daq = Fake(), Fake()
    bench = connect(plan_with(works(generator), works(daq)), WallClock())
    assert isinstance(bench.generator, GuardedGenerator)
    assert "generator.frequency" in bench.limits()
    assert bench.load_cell.sensitivity_V_N == 0.5
    assert not bench.simulated
    bench.close()
    assert ("close",) in generator.calls
    assert ("close",) in daq.calls


def test_all_instruments_are_tried_before_failures_are_reported() -> None:
    first = InstrumentError("generator", "*IDN?", "no answer", "switch it on")
    second = LimitError("daq: no such terminal", "correct it")
    with pytest.raises(RigError) as caught:
        connect(plan_with(fails(first), fails(second)), WallClock())
    assert [part.one_line() for part in caught.value.parts()] == [
        "generator: *IDN?: no answer; switch it on",
        "daq: no such terminal; correct it",
    ]
    assert caught.value.code == ExitCode.INSTRUMENT


def test_what_did_connect_is_closed_where_another_failed() -> None:
    generator = Fake()
    error = InstrumentError("daq", "*IDN?", "no answer")
    with pytest.raises(InstrumentError) as caught:
        connect(plan_with(works(generator), fails(error)), WallClock())
    assert caught.value is error
    assert [call for call in generator.calls if call != ("keep_alive",)] == [("close",)]
    assert generator.calls[-1] == ("close",), "nobody is fed over a link that is closed"


PATIENCE_S = 20.0


def test_instruments_on_links_of_their_own_are_connected_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=PATIENCE_S)

    def connected(settings: object, clock: object) -> Any:
        both.wait()
        return Fake()

    driver = SimpleNamespace(connect=connected)
    bench = connect(plan_with(driver, driver), WallClock())
    assert list(bench.instruments) == ["generator", "daq"]
    bench.close()


def test_instruments_on_one_link_are_connected_one_after_the_other() -> None:
    busy = threading.Lock()

    def connected(settings: object, clock: object) -> Any:
        assert busy.acquire(blocking=False), "two talk on one line"
        time.sleep(0.05)
        busy.release()
        return Fake()

    driver = SimpleNamespace(connect=connected)
    plan = plan_with(driver, driver)
    generator, daq = plan.instruments
    one_link = replace(generator, role="daq", driver=daq.driver)
    connect(replace(plan, instruments=(generator, one_link)), WallClock()).close()


def test_who_is_waited_for_is_reported_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.bench.connect.REPORT_EVERY_S", 0.1)
    reported, lines = threading.Event(), list[str]()

    def slowly(settings: object, clock: object) -> Any:
        assert reported.wait(PATIENCE_S), "nobody says what is waited for"
        return Fake()

    def tell(line: str) -> None:
        lines.append(line)
        if line.endswith("waiting for daq"):
            reported.set()

    plan = plan_with(works(Fake()), SimpleNamespace(connect=slowly))
    connect(plan, WallClock(), show_line=tell).close()
    assert re.fullmatch(r"connecting for \d+ s: waiting for daq", lines[-1])


def test_a_stop_while_connecting_leaves_nothing_connected() -> None:
    begun, stopped, fast, slow = threading.Event(), threading.Event(), Fake(), Fake()

    def slowly(settings: object, clock: object) -> Any:
        begun.set()
        assert stopped.wait(PATIENCE_S)
        return slow

    def check() -> None:
        if begun.is_set():
            stopped.set()
            raise RigError("stopped")

    plan = plan_with(works(fast), SimpleNamespace(connect=slowly))
    with pytest.raises(RigError, match="stopped"):
        connect(plan, WallClock(), check)
    # Its link's worker may have fed it once between the two.
    assert [call for call in slow.calls if call != ("keep_alive",)] == [("close",)]
    assert slow.calls[-1] == ("close",)
    assert fast.calls[-1:] in ([("close",)], []), "it may not have been begun"


def test_one_simulated_instrument_makes_the_bench_simulated() -> None:
    assert connect(plan_with(works(Fake()), works(Fake("SIM1"))), WallClock()).simulated


def test_a_declared_simulation_is_simulated() -> None:
    plan = plan_with(works(Fake()), works(Fake()))
    settings = plan.settings.model_copy(update={"simulation": {"seed": 1}})
    assert connect(replace(plan, settings=settings), WallClock()).simulated


@pytest.mark.parametrize(
    ("frequency", "amplitude", "reported"),
    [
        (1001.0, 1.0, "frequency 1001 Hz is outside 1 to 1000 Hz of the generator G"),
        (0.5, 1.0, "frequency 0.5 Hz"),
        (10.0, 2.1, "amplitude 2.1 V is outside 0.1 to 2 V"),
        (10.0, -1.0, "amplitude -1 V"),
        (float("nan"), 1.0, "frequency nan"),
        (10.0, float("inf"), "amplitude inf"),
    ],
)
def test_a_guarded_generator_refuses_before_anything_is_sent(
    frequency: float, amplitude: float, reported: str
) -> None:
    inner = Fake()
    with pytest.raises(LimitError) as caught:
        GuardedGenerator(inner).sine(frequency, amplitude)  # type: ignore[arg-type]
    assert reported in caught.value.message
    assert inner.calls == []


def test_a_guarded_generator_passes_on_what_is_inside() -> None:
    inner = Fake()
    generator = GuardedGenerator(inner)  # type: ignore[arg-type]
    generator.sine(1000.0, 2.0)
    generator.output(True)
    generator.make_safe()
    assert inner.calls == [("sine", 1000.0, 2.0), ("output", True), ("make_safe",)]


def test_require_names_value_unit_limit_device_and_place() -> None:
    limits = Limits(0, 5, "N", "load cell")
    require("load", 5, limits)
    with pytest.raises(LimitError) as caught:
        require("load", 5.5, limits, "point 3")
    assert caught.value.message == "point 3: load 5.5 N is outside 0 to 5 N of the load cell"


@pytest.mark.parametrize(
    "part", ["generator", "daq", "stage_x", "rotary", "film", "load_cell", "skin"]
)
def test_a_part_that_the_bench_has_not_is_named_when_it_is_asked_for(part: str) -> None:
    plan = parse_bench('name = "bare"\n[fixture]\nmounted = "plate"\n', "bare.toml")
    with pytest.raises(ConfigurationError, match=rf"bare\.toml.*{part}.*"):
        getattr(Bench(plan, WallClock(), {}, LinkWorkers(WallClock())), part)


def test_the_wrong_fixture_is_refused() -> None:
    plan = parse_bench('name = "bare"\n[fixture]\nmounted = "plate"\n', "bare.toml")
    plan.require_fixture("film-clamp", "plate")
    with pytest.raises(ConfigurationError, match=r"has the plate mounted.*needs film-clamp"):
        plan.require_fixture("film-clamp")


def test_what_the_points_need_is_missed_before_anything_is_connected() -> None:
    plan = parse_bench('name = "bare"\n[fixture]\nmounted = "plate"\n', "bare.toml")
    point = Point("p", None, (Move("generator.frequency", 200.0), Move("load_cell.load", 1.0)))
    with pytest.raises(ConfigurationError, match=r"bare\.toml.*: generator, load_cell"):
        require_roles([point], plan)


# --- the plate -------------------------------------------------------------------------------

PLATE = """
name = "bench-4"
[fixture]
mounted = "plate"
[skin]
name = "skin 2"
b_dB = { strip_1 = -62.5 }
b_error_dB = { strip_1 = 0.2 }
[daq]
driver = "keysight-u2300a"
resource = "TCPIP::192.168.0.13::INSTR"
channels = { strip_1 = 101, strip_2 = 102 }
"""


def test_a_skin_is_described_with_what_is_known_of_its_strips() -> None:
    skin = Bench(parse_bench(PLATE, "bench.toml"), WallClock(), {}, LinkWorkers(WallClock())).skin
    assert (skin.name, skin.amplifier_gain, skin.ridge) == ("skin 2", 1000.0, 3)
    assert skin.b_dB == {"strip_1": -62.5}, "the other strip is not calibrated"


def test_a_level_without_its_error_is_refused() -> None:
    assert "name the same strips" in refused(PLATE.replace("b_error_dB = { strip_1 = 0.2 }\n", ""))
    assert "b_error_dB is below 0" in refused(PLATE.replace("0.2 }", "-0.2 }"))


def test_a_strip_that_is_not_wired_or_not_known_is_refused() -> None:
    assert "wires no strip_2" in refused(PLATE.replace(", strip_2 = 102", ""))
    assert "strip_3" in refused(PLATE.replace("{ strip_1 = -", "{ strip_3 = -"))


# --- rehearsal -------------------------------------------------------------------------------


def test_a_rehearsal_keeps_the_real_limits_on_the_simulated_bench() -> None:
    real = parse_bench(changed("film-clamp", "plate"), "bench.toml")
    simulated = parse_bench(
        changed("bench-3", "simulated")
        .replace("192.168.0.12", "127.0.0.1")
        .replace("= 2.0", "= 10.0")
        .replace("max_load_N = 12.0", "max_load_N = 20.0")
        .replace("sensitivity_V_N = 0.5", "sensitivity_V_N = 0.1")
        .replace("film = 103", "film = 102"),
        "the simulated bench",
    )
    plan = rehearsal(real, simulated)
    generator, daq = (part.settings for part in plan.instruments)
    assert generator.max_amplitude_V == 2.0  # type: ignore[attr-defined]
    assert "127.0.0.1" in generator.resource  # type: ignore[attr-defined]
    assert daq.channels == {"load_cell": 101, "film": 102}  # type: ignore[attr-defined]
    assert plan.settings.fixture.mounted == "plate"
    assert plan.settings.name == "simulated"
    assert plan.settings.load_cell is not None
    assert plan.settings.load_cell.max_load_N == 12.0
    assert plan.settings.load_cell.sensitivity_V_N == 0.1, "of the simulated cell"


def stage(axis: str, high_mm: float, port: int = 502) -> str:
    return f"""
[stage_{axis}]
driver = "festo-cmmt"
axis = "{axis}"
host = "127.0.0.1"
port = {port}
low_limit_mm = 0.0
high_limit_mm = {high_mm}
max_speed_mm_s = 20.0
"""


def test_a_rehearsal_keeps_the_limits_of_each_of_two_equal_drives() -> None:
    real = parse_bench(PLATE + stage("z", 9.0) + stage("x", 25.0, 503), "bench.toml")
    simulated = PLATE + stage("z", 14.0, 1502) + stage("x", 40.0, 1503)
    plan = rehearsal(real, parse_bench(simulated, "the simulated bench"))
    own = {part.role: part.settings for part in plan.instruments}
    highest = {role: own[role].high_limit_mm for role in ("stage_z", "stage_x")}  # type: ignore[attr-defined]
    assert highest == {"stage_z": 9.0, "stage_x": 25.0}
    assert [own[role].port for role in ("stage_z", "stage_x")] == [1502, 1503]  # type: ignore[attr-defined]


def test_a_heartbeat_shorter_than_an_instruments_patience_is_refused() -> None:
    """A run that only waits for an answer must not be killed for hanging."""
    line = refused(GOOD.replace("heartbeat_timeout_s = 7", "heartbeat_timeout_s = 3"))
    assert "heartbeat_timeout_s 3 is not above 4 s" in line
    assert "generator" in line
    assert "daq" in line


DOOR = '\n[[interlock]]\nname = "door"\ninput = "daq.501.0"\nclass = "person"\n'


def test_an_interlock_names_an_input_of_an_instrument_of_the_bench() -> None:
    (door,) = parse_bench(GOOD + DOOR, "bench.toml").settings.interlock
    assert (door.role, door.line, door.kind, door.proof) == ("daq", "501.0", "person", False)
    assert door.is_closed(True)
    assert not door.is_closed(False)


@pytest.mark.parametrize(
    ("table", "reported"),
    [
        (DOOR.replace("daq.501.0", "daq.509.0"), "no such input; it has 501.0 to 504.3"),
        (DOOR.replace("daq.501.0", "stage_x.1"), "the bench has no stage_x"),
        (
            DOOR.replace("daq.501.0", "generator.1"),
            "the driver of the generator reads no inputs; the bench has inputs on daq",
        ),
        (DOOR.replace('"person"', '"nobody"'), "'person' or 'process'"),
        (DOOR.replace("class", "kind"), "kind: unknown key"),
        (DOOR + DOOR, "two [[interlock]] tables have the name 'door'"),
        (DOOR + DOOR.replace('"door"', '"gate"'), "two [[interlock]] tables have the input"),
    ],
)
def test_an_interlock_that_cannot_be_read_is_refused(table: str, reported: str) -> None:
    assert reported in refused(GOOD + table)


STAGES_BY_DRIVER = {
    "festo-cmmt": 'host = "192.168.0.20"\n',
    "oriental-az": 'port = "/dev/ttyUSB1"\nunit_id = 1\nsteps_per_mm = 3000.0\n',
}


@pytest.mark.parametrize("driver", STAGES_BY_DRIVER)
def test_a_link_that_leaves_no_time_for_a_second_request_is_refused(driver: str) -> None:
    """The defaults leave room for two time-outs of the link."""
    stage = (
        f'{GOOD}\n[stage_z]\ndriver = "{driver}"\naxis = "z"\n{STAGES_BY_DRIVER[driver]}'
        "low_limit_mm = 0\nhigh_limit_mm = 20\nmax_speed_mm_s = 20\n"
    )
    settings: Any = parse_bench(stage, "bench.toml").instruments[-1].settings
    assert 2 * settings.timeout_s < settings.communication_timeout_ms * 1e-3
    line = refused(f"{stage}timeout_s = 1.0\n")
    assert "[stage_z] timeout_s = 1 s leaves no time for a second request" in line
    assert "communication_timeout_ms = 1000 ms" in line
    assert "set timeout_s to 0.4 s or less for [stage_z]" in line
    assert "communication_timeout_ms to 2500 ms or more" in line
    assert parse_bench(f"{stage}timeout_s = 0.9\n", "bench.toml")


def test_a_dry_run_says_that_it_reads_no_interlock() -> None:
    real, simulated = parse_bench(GOOD + DOOR, "bench.toml"), parse_bench(GOOD, "simulated")
    assert "interlocks are not read in a dry run: door" in rehearsal(real, simulated).stand_ins


STAGES = """
name = "b"
[fixture]
mounted = "plate"
[stage_z]
driver = "{driver}"
axis = "z"
{z}
low_limit_mm = 0.0
high_limit_mm = 20.0
max_speed_mm_s = 20.0
torque_limit_percent = 25.0
[stage_x]
driver = "{driver}"
axis = "x"
{x}
low_limit_mm = 0.0
high_limit_mm = 40.0
max_speed_mm_s = 20.0
"""
LINE = 'port = "/dev/ttyUSB1"\nsteps_per_mm = 3000.0\nunit_id = '


@pytest.mark.parametrize(
    ("driver", "z", "x", "same"),
    [
        ("festo-cmmt", 'host = "h1"', 'host = "h1"', "host = h1, port = 502, unit_id = 1"),
        ("oriental-az", f"{LINE}1", f"{LINE}1", "port = /dev/ttyUSB1, unit_id = 1"),
        ("festo-cmmt", 'host = "h1"', 'host = "h1"\nport = 503', None),
        ("oriental-az", f"{LINE}1", f"{LINE}2", None),
    ],
)
def test_two_axes_that_name_one_drive_are_refused(
    driver: str, z: str, x: str, same: str | None
) -> None:
    """The motions of x, within its limits, would move z beyond its own, with the skin pressed."""
    text = STAGES.format(driver=driver, z=z, x=x)
    if same is None:
        assert len(parse_bench(text, "bench.toml").instruments) == 2
        return
    assert refused(text) == (
        f"bench.toml: [stage_z] and [stage_x] name the same instrument ({same}): what is meant "
        "for stage_x would act on stage_z; give each its own address"
    )
    assert len(parse_bench(f"{text}\n[simulation]\nseed = 1\n", "a record").instruments) == 2

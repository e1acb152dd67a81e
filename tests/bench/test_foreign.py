"""What a driver of another package returns when it is connected, and where its stage is seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig.bench import connect as connecting
from rig.bench.connect import connect
from rig.bench.connected import close_all
from rig.bench.foreign import (
    checked_daq,
    checked_force_sensor,
    checked_generator,
    checked_stage,
    connect_foreign,
)
from rig.bench.plan import BenchPlan, InstrumentPlan
from rig.core.clock import WallClock
from rig.core.entry_points import BrokenPackageError
from rig.core.errors import InstrumentError, WrongFramesError, WrongPositionError
from rig.core.settings import Settings
from rig.instruments.roles import (
    Acquisition,
    ForceFrames,
    Identity,
    InputChannel,
    Limits,
    Record,
    ReportsFault,
    Scaling,
)

ENTRY = EntryPoint("zstage", "zstage.driver", "rig.drivers")
PART: Any = InstrumentPlan("stage_x", "zstage", None, Settings())  # type: ignore[arg-type]


class Stage:
    """A stage that stands where it is put."""

    def __init__(self) -> None:
        self.identity: Any = Identity("Lab", "Z", "1", "2")
        self.within: Any = {
            "position": Limits(0.0, 40.0, "mm", "stage_x"),
            "speed": Limits(0.1, 20.0, "mm/s", "stage_x"),
            "update_rate": Limits(0.0, 100.0, "Hz", "stage_x"),
        }
        self.at: Any = 10.0
        self.sent: list[str] = []
        self.closed = False

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name in ("homed", "home", "start_move", "move_to", "stop", "make_safe", "keep_alive"):
            return lambda *given: self.sent.append(name)
        if name in ("moving", "acknowledge_timeout"):
            return lambda: False
        raise AttributeError(name)

    def limits(self) -> Any:
        return self.within

    def position_mm(self) -> Any:
        return self.at

    def fault(self) -> str | None:
        return None

    def close(self) -> None:
        self.closed = True


def wrong(**values: Any) -> Stage:
    stage = Stage()
    for name, value in values.items():
        setattr(stage, name, value)
    return stage


CONNECTED = {
    "None": (lambda: None, "connect() returned None"),
    "a list of limits": (lambda: wrong(within=[1]), "limits() returned a list, not a mapping"),
    "a limit without one": (
        lambda: wrong(within={"position": (0, 40)}),
        "limits() has position = a tuple, not a Limits",
    ),
    "a missing limit": (lambda: wrong(within={}), "limits() lacks position, speed, update_rate"),
    "no identity": (lambda: wrong(identity=None), "identity is None, not an Identity"),
    "an identity of numbers": (
        lambda: wrong(identity=Identity("Lab", 1, b"x", 2.0)),  # type: ignore[arg-type]
        "identity has model = 1, not a text",
    ),
    "an identity of bytes": (
        lambda: wrong(identity=Identity("Lab", "Z", b"x", "2")),  # type: ignore[arg-type]
        "identity has serial_number = a bytes, not a text",
    ),
    "a limit that is not known": (
        lambda: wrong(within={"position": Limits(math.nan, 40.0, "mm", "stage_x")}),
        "limits() has position with low = nan, not a number",
    ),
    "a limit of texts": (
        lambda: wrong(within={"speed": Limits(0.0, "20", "mm/s", "stage_x")}),  # type: ignore[arg-type]
        "limits() has speed with high = '20', not a number",
    ),
    "a limit without a unit": (
        lambda: wrong(within={"speed": Limits(0.0, 20.0, None, "stage_x")}),  # type: ignore[arg-type]
        "limits() has speed with unit = None, not a text",
    ),
    "limits the wrong way round": (
        lambda: wrong(within={"position": Limits(40.0, 0.0, "mm", "stage_x")}),
        "limits() has position with low = 40 mm, above high = 0 mm",
    ),
    "no stop": (lambda: wrong(stop=None), "returned a Stage without stop, which a stage_x needs"),
    "an exception": (lambda: [][0], "cannot connect: "),
}


@pytest.mark.parametrize("kind", CONNECTED)
def test_what_connects_wrongly_is_closed_and_its_package_named(kind: str) -> None:
    make, words = CONNECTED[kind]
    made: list[Any] = []

    def connected() -> Any:
        made.append(make())
        return made[0]

    with pytest.raises(BrokenPackageError) as raised:
        connect_foreign(PART, ENTRY, connected)
    assert "driver 'zstage' of the package" in raised.value.message
    assert words in raised.value.message
    assert all(one.closed for one in made if one is not None)


def test_it_is_refused_where_the_bench_is_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connecting, "foreign", lambda part: ENTRY)

    class Driver:
        @staticmethod
        def connect(settings: Any, clock: Any) -> None:
            return None

    part = InstrumentPlan("stage_x", "zstage", Driver, Settings())  # type: ignore[arg-type]
    plan = BenchPlan(None, (part,), "", "")  # type: ignore[arg-type]
    with pytest.raises(BrokenPackageError, match=r"connect\(\) returned None"):
        connect(plan, WallClock())


def test_one_that_cannot_be_closed_keeps_no_other_from_it() -> None:
    last = Stage()
    close_all({"stage_x": None, "stage_z": last})  # type: ignore[dict-item]
    assert last.closed


def test_a_limit_may_be_infinite_or_a_whole_number() -> None:
    stage = wrong(within=Stage().within | {"update_rate": Limits(0, math.inf, "Hz", "stage_x")})
    assert connect_foreign(PART, ENTRY, lambda: stage).limits() == stage.within


@pytest.mark.parametrize("at", [float("nan"), float("inf"), "10.0", None, True])
def test_a_position_that_is_not_a_finite_number_raises_and_all_else_is_sent(at: Any) -> None:
    inner = wrong(at=at)
    stage = checked_stage("stage_x", inner, "'zstage' of the package lab")
    with pytest.raises(WrongPositionError, match=r"^stage_x: position_mm: returned ") as raised:
        stage.position_mm()
    assert isinstance(raised.value, InstrumentError)
    assert "the driver 'zstage' of the package lab" in str(raised.value.hint)
    stage.start_move(5.0, 1.0)
    stage.stop()
    stage.make_safe()
    stage.keep_alive()
    stage.move_to(5.0, 1.0)
    assert inner.sent == ["start_move", "stop", "make_safe", "keep_alive", "move_to"]
    assert isinstance(stage, ReportsFault)
    assert stage.identity is inner.identity


def test_an_axis_beyond_its_limits_may_come_back_and_is_not_seen_there_again() -> None:
    inner = wrong(at=45.0)
    stage = checked_stage("stage_x", inner, "'zstage' of the package lab")
    assert stage.position_mm() == 45.0
    stage.start_move(20.0, 1.0)
    assert stage.position_mm() == 45.0
    stage.stop()
    assert not stage.moving()
    assert stage.position_mm() == 45.0, "stopped on its way"
    inner.at = 40.5
    assert stage.position_mm() == 40.5, "within the tolerance"
    inner.at = 45.0
    with pytest.raises(WrongPositionError, match="45 mm, outside its limits of 0 to 40 mm"):
        stage.position_mm()
    stage.home()
    assert stage.position_mm() == 45.0, "another reference"
    stage.start_move(20.0, 1.0)
    assert not stage.moving()
    with pytest.raises(WrongPositionError):
        stage.position_mm()


def test_a_whole_number_is_a_position() -> None:
    position = checked_stage("stage_x", wrong(at=7), "").position_mm()
    assert (position, type(position)) == (7.0, float)


class Gauge:
    """A force sensor with one axis that returns what it is given."""

    axes = "z"

    def __init__(self, returned: Any):
        self.returned = returned

    def read(self) -> Any:
        return self.returned

    def stop(self) -> str:
        return "stopped"


def force_frames(force_N: Any, rows: int = 4) -> ForceFrames:
    raw = np.zeros((rows, 3), np.float32)
    return ForceFrames(0, raw, force_N, np.zeros(rows, np.bool_), raw_unit="N")


ALL_NAN = np.full((4, 3), np.nan)
LAST_INFINITE = np.zeros((4, 3))
LAST_INFINITE[3, 0] = np.inf


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (force_frames(ALL_NAN), "returned a force of nan N along z"),
        (force_frames(LAST_INFINITE), "returned a force of inf N along x"),
        (force_frames(np.zeros((4, 1))), r"returned force_N of the shape \(4, 1\), not \(4, 3\)"),
        (3.5, "returned 3.5, not ForceFrames"),
        ([1.0, 2.0], "returned a list, not ForceFrames"),
    ],
    ids=["nan", "one infinite", "another shape", "a number", "a list"],
)
def test_frames_without_forces_name_the_driver(returned: Any, words: str) -> None:
    sensor = checked_force_sensor(Gauge(returned), "'gauge' of the package lab")
    with pytest.raises(WrongFramesError, match=words) as caught:
        sensor.read()
    assert "the driver 'gauge' of the package lab" in str(caught.value.hint)


def test_frames_with_forces_are_handed_over_as_they_are() -> None:
    good = force_frames(np.ones((4, 3)))
    sensor = checked_force_sensor(Gauge(good), "'gauge' of the package lab")
    assert sensor.read() is good
    assert (sensor.axes, sensor.stop()) == ("z", "stopped")
    assert checked_force_sensor(Gauge(None), "").read() is None


class GaugeOfRate(Gauge):
    """A gauge that returns this from its start."""

    def __init__(self, rate: Any):
        super().__init__(None)
        self.rate = rate

    def start(self, rate_S_s: float) -> Any:
        return self.rate


@pytest.mark.parametrize("returned", [None, "400", True, 0.0, math.nan, math.inf])
def test_a_start_without_a_rate_names_the_driver(returned: Any) -> None:
    sensor = checked_force_sensor(GaugeOfRate(returned), "'gauge' of the package lab")
    with pytest.raises(InstrumentError, match="not the rate of the stream in frames/s") as caught:
        sensor.start(100.0)
    assert "the driver 'gauge' of the package lab" in caught.value.one_line()
    assert checked_force_sensor(GaugeOfRate(np.float32(400)), "").start(100.0) == 400.0


class Generator:
    """A generator that gives this answer about its output."""

    def __init__(self, on: Any):
        self.on, self.sent = on, list[str]()

    def make_safe(self) -> None:
        self.sent.append("off")

    def output_is_on(self) -> Any:
        self.sent.append("asked")
        return self.on


def test_a_generator_that_was_made_safe_is_asked_afterwards() -> None:
    generator = Generator(on=False)
    checked_generator(generator, "'acme' of the package lab").make_safe()
    assert generator.sent == ["off", "asked"]


@pytest.mark.parametrize("on", [True, None, 0, "OFF"])
def test_a_generator_that_is_still_on_or_does_not_say_is_not_safe(on: Any) -> None:
    checked = checked_generator(Generator(on), "'acme' of the package lab")
    with pytest.raises(InstrumentError, match="its output is still on") as raised:
        checked.make_safe()
    assert "'acme' of the package lab" in raised.value.one_line()


PLAN = Acquisition((InputChannel("strip_1", 1.25), InputChannel("strip_2", 1.25)), 1000.0, 4)
NONE = (0.0, 0.0)
STEPS = (4e-5, 4e-5)
RANGES = (1.25, 1.25)
SCALING = Scaling(("strip_1", "strip_2"), 1000.0, STEPS, NONE, RANGES, NONE, -32768, 32767)
COUNTS = np.zeros((4, 2), np.int16)


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (10.0, "returned 10.0, not a tuple of full scales in V"),
        (None, "returned None, not a tuple of full scales in V"),
        ((), "returned no range"),
        (("10 V",), "returned the range '10 V', not a full scale in V"),
        ((1.0, math.nan), "returned the range nan, not a full scale in V"),
        ((10.0, 1.0), "returned ranges that do not ascend"),
    ],
)
def test_ranges_that_are_none_name_the_driver(returned: Any, words: str) -> None:
    daq = checked_daq(SimpleNamespace(ranges_V=lambda: returned), "'ad' of the package lab")
    with pytest.raises(InstrumentError, match="ranges_V") as caught:
        daq.ranges_V()
    assert words in caught.value.one_line()
    assert "the driver 'ad' of the package lab" in caught.value.one_line()
    good = SimpleNamespace(ranges_V=lambda: [1, 10.0])
    assert checked_daq(good, "").ranges_V() == (1.0, 10.0)


class Converter:
    """A DAQ that returns what it was given, one after the other."""

    def __init__(self, *returned: Any, scaling: Any = SCALING):
        self.returned, self.scaling = list(returned), scaling

    def start(self, acquisition: Acquisition) -> Any:
        return self.scaling

    def read(self) -> Any:
        return self.returned.pop(0)

    def acquire(self, acquisition: Acquisition) -> Any:
        return self.returned.pop(0)

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802
        return (1.25,)


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        ([COUNTS], "returned a list, not a Record"),
        (Record(COUNTS * 1.0, SCALING, 0), "counts of the type float64, not int16"),  # type: ignore[arg-type]
        (Record(COUNTS.tolist(), SCALING, 0), "counts of the type list, not int16"),
        (Record(COUNTS.T, SCALING, 0), r"counts of the shape \(2, 4\), not \(n, 2\)"),
        (Record(COUNTS[:, :1], SCALING, 0), r"counts of the shape \(4, 1\), not \(n, 2\)"),
        (Record(COUNTS, SCALING, 7), "samples from 7 on, where 0 comes next: a gap"),
        (Record(COUNTS, None, 0), "returned None, not a Scaling"),  # type: ignore[arg-type]
    ],
)
def test_samples_that_cannot_be_recorded_name_the_driver(returned: Any, words: str) -> None:
    for take in ("read", "acquire"):
        daq = checked_daq(Converter(returned), "'mole' of the package lab")
        daq.start(PLAN)
        with pytest.raises(InstrumentError, match=words) as caught:
            daq.read() if take == "read" else daq.acquire(PLAN)
        assert "the driver 'mole' of the package lab" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"channels": ("strip_2", "strip_1")},
            r"channels \('strip_2', 'strip_1'\), not \('strip_1', 'strip_2'\)",
        ),
        ({"rate_S_s": 500.0}, "a rate of 500 1/s, where 1000 1/s was asked for"),
        ({"volts_per_count": (math.nan, 1.0)}, r"volts_per_count = \(nan, 1.0\), not 2 finite"),
        ({"volts_per_count": (0.0, 1.0)}, r"volts_per_count = \(0.0, 1.0\)"),
        ({"delay_s": (0.0,)}, r"delay_s = \(0.0,\), not 2 finite numbers"),
        ({"delay_s": None}, "a scaling that is not of numbers, one a channel"),
        ({"volts_per_count": 1e-5}, "a scaling that is not of numbers, one a channel"),
        ({"rate_S_s": None}, "a scaling that is not of numbers, one a channel"),
        ({"lowest_count": None}, "a scaling that is not of numbers, one a channel"),
    ],
)
def test_a_scaling_that_gives_no_volts_ends_the_acquisition(changed: Any, words: str) -> None:
    daq = checked_daq(Converter(scaling=replace(SCALING, **changed)), "'mole' of the package lab")
    with pytest.raises(InstrumentError, match=words):
        daq.start(PLAN)


def test_samples_that_follow_each_other_are_handed_over_as_they_are() -> None:
    blocks = Record(COUNTS, SCALING, 0), Record(COUNTS, SCALING, 4)
    daq = checked_daq(Converter(None, *blocks, blocks[0]), "")
    assert daq.start(PLAN) is SCALING
    assert daq.read() is None
    assert daq.read() is blocks[0]
    assert daq.read() is blocks[1]
    assert daq.acquire(PLAN) is blocks[0]
    assert daq.ranges_V() == (1.25,)


def test_a_record_that_is_too_short_is_refused() -> None:
    daq = checked_daq(Converter(Record(COUNTS[:3], SCALING, 0)), "'mole' of the package lab")
    with pytest.raises(InstrumentError, match="3 samples, not 4"):
        daq.acquire(PLAN)

"""The bench with the plate, a process of its own, through the real drivers over TCP and a pty.

What it measures is compared with the pure model under the motion that the World's log tells.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.simulated.bench.options import Options
from drivers.simulated.bench.start import start
from drivers.simulated.instruments.gsv8_converter import NOISE_MV_V, Sensor
from drivers.simulated.world.axis import AxisCommand, Mechanics, SimulatedAxis
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.plan import parse_bench
from rig.core.cache import DiskCache
from rig.core.clock import ControlLink, SlavedClock
from rig.core.errors import ConfigurationError, InstrumentError
from rig.instruments.roles import Acquisition, ForceFrames, InputChannel, Record
from rig.physics.contact.settings import ContactSettings, Plate
from rig.physics.contact.stepper import ContactStepper
from rig.physics.contact.truth import SlipWatch
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.transducer import TransducerChain, TransducerSettings

STEP_us = 100
CONVERSIONS = 48
"""Of the force sensor's converter in a frame of 1 ms."""
ACCELERATION = round(0.2 * 0x4000) / 0x4000 * 1000.0
"""200 mm/s^2, as it is set in a drive of 1000 mm/s^2."""
WORLD = """
[skin]
elements_per_ridge = 6
[strip_input]
noise_density_V_sqrtHz = 0.0
mains_amplitude_mV = 0.0
"""


class Started:
    """The bench with its drivers connected, everything read as it comes."""

    def __init__(self, folder: Path, world: str = "", **options: Any):
        (folder / "world.toml").write_text(WORLD + world)
        self.log_file = folder / "world.jsonl"
        files = {"world": str(folder / "world.toml"), "world_log": str(self.log_file)}
        self.process = start({"fixture": "plate", "seed": 5, **files, **options})
        said = self.process.ready()
        self.text: str = said["bench_toml"]
        self.recorded: str = said["recorded_toml"]
        self.clock = SlavedClock(ControlLink(said["control_port"]))
        self.bench: Bench = connect(parse_bench(self.text, "the simulated bench"), self.clock)
        self.frames: list[ForceFrames] = []
        self.blocks: list[Record] = []
        self.acquiring = False

    def wait(self, seconds: float) -> None:
        """Let time pass and read the streams."""
        for _ in range(round(seconds * 100)):
            self.clock.sleep(0.01)
            if (frames := self.bench.force_sensor.read()) is not None:
                self.frames.append(frames)
            while self.acquiring and (block := self.bench.daq.read()) is not None:
                self.blocks.append(block)

    def go(self, role: str, target_mm: float, speed_mm_s: float) -> None:
        """Move and read meanwhile."""
        stage = getattr(self.bench, role)
        stage.start_move(target_mm, speed_mm_s)
        while stage.moving():
            self.wait(0.01)
        stage.stop()

    def close(self) -> None:
        self.bench.close()
        self.process.wait()

    def log(self, device: str, what: str) -> list[tuple[int, Any]]:
        """When the World's log tells this of a device, and what."""
        entries = [json.loads(line) for line in self.log_file.read_text().splitlines()]
        return [
            (entry["t_us"], entry["value"])
            for entry in entries
            if (entry["device"], entry["what"]) == (device, what)
        ]


@pytest.fixture(autouse=True)
def cached(monkeypatch: pytest.MonkeyPatch, skin_cache: DiskCache, skin6: CondensedSkin) -> None:
    """The World finds its skin where these tests keep it."""
    monkeypatch.setenv("RIG_CACHE", str(skin_cache.folder))


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Started]:
    with closing(Started(tmp_path)) as bench:
        yield bench


def moved(bench: Started, stage: str) -> SimulatedAxis:
    """The stage as the World's log says that it was moved, on an axis that nothing holds."""
    axis = SimulatedAxis(Mechanics(), lambda position_mm, t_us: 0.0)
    orders = [
        (t, AxisCommand(home, 20.0, 1000.0, 1000.0)) for t, home in bench.log(stage, "homing")
    ]
    for t, move in bench.log(stage, "move"):
        own = (move["target_mm"], move["speed_mm_s"], ACCELERATION, ACCELERATION)
        orders.append((t, AxisCommand(*own)))
    for t, order in sorted(orders, key=lambda one: one[0]):
        axis.move(t, order)
    return axis


@pytest.mark.thorough
def test_sensors_and_truth_are_the_models(started: Started, skin6: CondensedSkin) -> None:
    bench = started.bench
    for stage in (bench.stage_z, bench.stage_x):
        stage.home()
    bench.force_sensor.start(1000.0)
    started.go("stage_x", 10.0, 20.0)
    started.go("stage_z", 12.3, 20.0)
    started.clock.announce(0, 1)
    strips = (InputChannel("strip_1", 2.5), InputChannel("strip_2", 2.5))
    scaling = bench.daq.start(Acquisition(strips, 20e3, 200))
    started.acquiring = True
    started.go("stage_z", 12.4431, 1.0)
    started.wait(0.1)
    started.go("stage_x", 10.25, 0.5)
    truth = started.clock.truth()
    end_us = truth["slide_us"] + 700_000
    started.wait(0.1)
    bench.daq.stop()
    bench.force_sensor.stop()

    times = np.arange(0, end_us, STEP_us)
    approach = moved(started, "stage_z").positions(times) - 12.4
    x = moved(started, "stage_x").positions(times)
    stepper = ContactStepper(skin6, ContactSettings(), Plate(), position_mm=10.0)
    block = stepper.advance(approach, x, normal_control="position")
    volts = TransducerChain(TransducerSettings(), 1e-4).advance(block.stress_MPa[:, :, 1])
    ends_s = (times + STEP_us) * 1e-6

    _compare_forces(started, ends_s, block.tangential_force_N, block.normal_force_N)
    (begun,) = [t for t, value in started.log("daq", "acquisition") if value == "run"]
    half_count_V = max(scaling.volts_per_count) / 2
    for strip, column in (("strip_1", 0), ("strip_2", 1)):
        read = np.concatenate([record.volts(strip) for record in started.blocks])
        at = begun * 1e-6 + np.arange(len(read)) / 20e3
        known = at < ends_s[-1]
        expected = np.interp(at[known], ends_s, volts[:, column])
        assert known.sum() > 15_000
        assert np.abs(read[known] - expected).max() < half_count_V * (1 + 1e-6) + 1e-9
        assert np.ptp(expected) > 100 * half_count_V

    first = truth["slide_us"] // STEP_us
    watch = SlipWatch(skin6.ridge, 1e-4)
    watch.add(block.status[first:])
    model = watch.truth()
    whole = [truth["slide_us"] + round(at * 1e6) for at in model.whole_slip_s]
    assert truth["whole_slip_us"] == whole
    assert truth["gross_slip_us"] == truth["slide_us"] + round(model.gross_slip_s * 1e6)
    (touched_us,) = truth["touch_down_us"]
    assert truth["since_us"] < touched_us < truth["slide_us"] < whole[2] < truth["gross_slip_us"]


def _compare_forces(
    started: Started, ends_s: np.ndarray, tangential: np.ndarray, normal: np.ndarray
) -> None:
    """Each frame is the mean of its conversions; the amplifier's noise is all that differs."""
    felt = np.concatenate([frames.force_N for frames in started.frames])
    felt = felt - felt[:200].mean(axis=0)
    begun = [t for t, on in started.log("force_sensor", "streaming") if on][-1]
    conversions = begun * 1e-6 + (np.arange(len(felt) * CONVERSIONS) + 1) / (1000 * CONVERSIONS)
    known = conversions[CONVERSIONS - 1 :: CONVERSIONS] < ends_s[-1]
    noise_N = NOISE_MV_V * np.linalg.norm(Sensor().matrix, axis=1)
    for axis, force in ((0, tangential), (1, np.zeros_like(normal)), (2, normal)):
        means = np.interp(conversions, ends_s, force).reshape(-1, CONVERSIONS).mean(axis=1)
        off = (felt[:, axis] - means)[known]
        assert known.sum() > 1500
        assert np.abs(off).max() < 6 * noise_N[axis]
        assert off.std() == pytest.approx(noise_N[axis], rel=0.1)
    assert felt[:, 2].max() == pytest.approx(4.0, abs=0.5)


def test_both_stages_are_kept_alive_guarded_and_made_safe(started: Started) -> None:
    bench = started.bench
    for stage in (bench.stage_z, bench.stage_x):
        stage.home()
    assert set(bench.instruments) == {"daq", "stage_z", "stage_x", "force_sensor"}
    bench.stage_x.start_move(35.0, 10.0)
    started.clock.sleep(2.0)  # twice the drives' time-out
    assert bench.stage_x.moving()
    assert not bench.stage_z.moving()
    for instrument in bench.instruments.values():
        instrument.make_safe()
    started.clock.sleep(0.5)
    rest = bench.stage_x.position_mm()
    started.clock.sleep(0.2)
    assert bench.stage_x.position_mm() == rest < 35.0
    limits = bench.limits()
    assert (limits["stage_x.position"].high, limits["stage_z.position"].high) == (40.0, 14.0)


@pytest.mark.thorough
def test_a_contact_without_a_solution_ends_the_run_and_lets_it_make_the_bench_safe(
    tmp_path: Path,
) -> None:
    """Friction of rubber on rubber that falls at once to its half, slid fast."""
    friction = """
[contact.friction]
static_coefficient = 3.0
kinetic_coefficient = 1.5
weakening_distance_um = 0.001
"""
    with closing(Started(tmp_path, friction)) as started:
        stages = (started.bench.stage_z, started.bench.stage_x)
        for stage in stages:
            stage.home()
        started.go("stage_x", 10.0, 20.0)
        started.go("stage_z", 12.44, 5.0)
        with pytest.raises(
            InstrumentError, match=r"contact has failed after \d+ us.*no consistent"
        ):
            started.go("stage_x", 14.0, 10.0)
        for stage in stages:
            stage.make_safe()
        started.clock.sleep(0.5)
        assert started.bench.stage_x.position_mm() != 14.0
        with pytest.raises(InstrumentError, match="no consistent"):
            started.clock.truth()
        with pytest.raises(InstrumentError, match="no consistent"):
            started.clock.announce(0, 2)
    assert len(started.log("world", "contact-failed")) == 1


@pytest.mark.thorough
def test_the_bench_file_describes_skin_and_plate(started: Started) -> None:
    tables = tomllib.loads(started.text)
    assert tables["fixture"]["mounted"] == "plate"
    assert tables["daq"]["channels"] == {"strip_1": 101, "strip_2": 102}
    assert "generator" not in tables
    assert "film" not in tables
    assert started.bench.skin.ridge == 3
    assert started.bench.skin.amplifier_gain == 1000.0
    assert started.bench.skin.b_dB == {}
    assert started.bench.daq.identity.model == "U2542A"
    assert started.bench.simulated
    anywhere = tomllib.loads(started.recorded)
    assert (anywhere["stage_x"]["port"], anywhere["stage_z"]["port"]) == (502, 502)


@pytest.mark.thorough
def test_what_no_simulated_bench_has_is_refused(tmp_path: Path) -> None:
    unknown: Any = "glove"
    refused = start({"fixture": unknown})
    with pytest.raises(ConfigurationError, match="no glove to mount"):
        refused.ready()
    refused.wait()
    plan = tmp_path / "fault.toml"
    plan.write_text('[[fault]]\ndevice = "generator"\nkind = "silence"\n')
    refused = start({"fixture": "plate", "fault": str(plan)})
    with pytest.raises(ConfigurationError, match="no such device"):
        refused.ready()
    refused.wait()


def test_a_film_is_clamped_unless_asked_otherwise() -> None:
    assert Options().fixture == "film-clamp"
    started = start({})
    said = started.ready()
    clock = SlavedClock(ControlLink(said["control_port"]))
    tables = tomllib.loads(said["bench_toml"])
    assert tables["fixture"]["mounted"] == "film-clamp"
    assert {"generator", "film", "load_cell"} <= tables.keys()
    assert not {"skin", "stage_x"} & tables.keys()
    assert set(clock.truth()) == {"film"}
    clock.close()
    started.wait()

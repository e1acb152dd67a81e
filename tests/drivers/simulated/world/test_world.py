"""The World: what its terminals carry, and noise that depends on nothing but its key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.simulated.faults.plan import FaultPlan, TimedFault
from drivers.simulated.ports import Excitation
from drivers.simulated.world.mounted_film import (
    AMPLIFIER_CLIP_V,
    FILM_TERMINAL,
    LOAD_CELL_TERMINAL,
)
from drivers.simulated.world.sampled_noise import NOISE_CHUNK
from drivers.simulated.world.settings import WorldSettings, read_world
from drivers.simulated.world.world import World
from rig.core.errors import ConfigurationError

RATE = 50e3
BOTH = (LOAD_CELL_TERMINAL, FILM_TERMINAL)
QUIET = {"noise_density_V_sqrtHz": 0.0, "mains_amplitude_mV": 0.0}
SILENT = {"film_input": QUIET, "load_cell_input": QUIET}


def world(seed: int = 3, **settings: object) -> World:
    return World(WorldSettings.model_validate(settings), seed, slaved=True)


def drive(of: World, amplitude: float, frequency: float = 200.0, on: bool = True) -> None:
    of.excite(1, Excitation(on, "SIN", frequency, amplitude, 0.0, 0.0), "test")


def sampled(
    of: World, count: int = 2000, terminals: tuple[int, ...] = BOTH, first: int = 0, at_us: int = 0
) -> np.ndarray:
    """A fresh acquisition's volts."""
    number = of.begin_acquisition()
    return of.volts(number, terminals, at_us, RATE, first, count, (0.0,) * len(terminals))


def test_a_driven_bench_loads_the_cell_and_the_film() -> None:
    bench = world(**SILENT)
    assert not sampled(bench).any(), "nothing is driven"
    drive(bench, 0.7)
    settled = sampled(bench, at_us=2_000_000)
    cell, film = np.ptp(settled, axis=0) / 2
    assert 0.01 < cell < 1
    assert 0.01 < film < 5
    drive(bench, 1.4)
    assert np.ptp(sampled(bench, at_us=4_000_000), axis=0) / 2 == pytest.approx(
        [2 * cell, 2 * film], rel=1e-6
    )


def test_the_other_channel_drives_nothing() -> None:
    bench = world(**SILENT)
    bench.excite(2, Excitation(True, "SIN", 200.0, 5.0, 0.0, 0.0), "test")
    assert not sampled(bench, at_us=1_000_000).any()


def test_a_late_channel_sees_the_same_signal_later() -> None:
    bench = world(**SILENT)
    drive(bench, 1.0)
    number = bench.begin_acquisition()
    skew = 7 / RATE
    twice = bench.volts(number, (FILM_TERMINAL, FILM_TERMINAL), 10_000, RATE, 0, 1000, (0.0, skew))
    assert twice[:-7, 1] == pytest.approx(twice[7:, 0], abs=1e-9)


def test_an_open_film_carries_noise_and_hum_only() -> None:
    quiet, noisy = world(film="open-circuit", **SILENT), world(film="open-circuit")
    for bench in (quiet, noisy):
        drive(bench, 1.0)
    assert not sampled(quiet, terminals=(FILM_TERMINAL,), at_us=10_000).any()
    assert np.ptp(sampled(quiet, at_us=10_000)[:, 0]) > 0.01, "the load cell is still there"
    assert 0 < np.abs(sampled(noisy, terminals=(FILM_TERMINAL,))).max() < 0.01


def test_the_films_amplifier_clips_and_the_load_cell_does_not_care() -> None:
    mild, loud = world(film_gain=1.0, **SILENT), world(film_gain=1000.0, **SILENT)
    for bench in (mild, loud):
        drive(bench, 1.0)
    plain, clipped = sampled(mild, at_us=10_000), sampled(loud, at_us=10_000)
    assert clipped[:, 1].max() == AMPLIFIER_CLIP_V
    assert clipped[:, 1].min() == -AMPLIFIER_CLIP_V
    expected = np.clip(1000 * plain[:, 1], -AMPLIFIER_CLIP_V, AMPLIFIER_CLIP_V)
    assert clipped[:, 1] == pytest.approx(expected)
    assert (clipped[:, 0] == plain[:, 0]).all()


def test_noise_is_of_the_stated_size() -> None:
    density = {"noise_density_V_sqrtHz": 1e-5, "mains_amplitude_mV": 0.0}
    bench = world(film="open-circuit", film_input=density)
    noise = sampled(bench, 20_000, (FILM_TERMINAL,))[:, 0]
    from rig.physics.front_end import noise_rms

    expected = noise_rms(bench.settings.film_input, RATE)
    assert noise.std() == pytest.approx(expected, rel=0.05)
    neighbours = np.corrcoef(noise[:-1], noise[1:])[0, 1]
    assert abs(neighbours) < 0.05


@pytest.mark.parametrize("size", [1, 10, NOISE_CHUNK - 1, NOISE_CHUNK, 3 * NOISE_CHUNK])
def test_noise_does_not_depend_on_the_blocks_it_is_read_in(size: int) -> None:
    bench = world(film="open-circuit")
    number = bench.begin_acquisition()
    count = 3 * NOISE_CHUNK if size > 1 else 100

    def read(first: int, rows: int) -> np.ndarray:
        return bench.volts(number, (FILM_TERMINAL,), 0, RATE, first, rows, (0.0,))

    whole = read(0, count)
    blocks = [read(first, min(size, count - first)) for first in range(0, count, size)]
    assert (np.concatenate(blocks) == whole).all()
    assert (read(count // 2, 50) == whole[count // 2 : count // 2 + 50]).all(), "random access"


def test_a_points_noise_does_not_depend_on_what_came_before_it() -> None:
    fresh, used = world(), world()
    used.announce(0, 17)
    for _ in range(5):
        sampled(used)
    for bench in (fresh, used):
        bench.announce(2, 40)
    for _ in range(3):
        assert (sampled(fresh) == sampled(used)).all()


def keyed_noise(
    seed: int = 3, run: int = 0, point: int = 0, earlier: int = 0, terminal: int = FILM_TERMINAL
) -> np.ndarray:
    bench = world(seed, film="open-circuit")
    bench.announce(run, point)
    for _ in range(earlier):
        sampled(bench)
    return sampled(bench, terminals=(terminal,))[:, 0]


@pytest.mark.parametrize(
    "key",
    [{"seed": 4}, {"run": 1}, {"point": 1}, {"earlier": 1}, {"terminal": LOAD_CELL_TERMINAL}],
    ids=lambda key: next(iter(key)),
)
def test_every_part_of_its_key_makes_other_noise(key: dict[str, int]) -> None:
    one, other = keyed_noise(), keyed_noise(**key)
    assert (keyed_noise(**key) == other).all(), "the same key gives the same noise"
    assert abs(np.corrcoef(np.diff(one), np.diff(other))[0, 1]) < 0.1


def test_the_film_is_drawn_from_the_seed() -> None:
    def response(seed: int, film: str) -> np.ndarray:
        bench = world(seed, film=film, **SILENT)
        drive(bench, 1.0)
        return sampled(bench, at_us=100_000)

    assert (response(1, "drawn") == response(1, "drawn")).all()
    assert np.abs(response(1, "drawn") - response(2, "drawn")).max() > 1e-3
    assert (response(1, "nominal") == response(2, "nominal")).all()


def test_the_log_tells_what_happened_and_when(tmp_path: Path) -> None:
    path = tmp_path / "world.jsonl"
    bench = World(WorldSettings(), 0, slaved=True, log=path)
    bench.timeline.advance(1500)
    bench.log("generator", "ch1.on", True, "socket#1")
    (said,) = [json.loads(line) for line in path.read_text().splitlines()]
    assert said == {
        "t_us": 1500, "device": "generator", "what": "ch1.on", "value": True, "by": "socket#1",
    }  # fmt: skip
    bench.close()
    assert json.loads(path.read_text().splitlines()[-1])["what"] == "end"


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ('film = "torn"\n', "film = 'torn'"),
        ("film_gian = 2\n", "film_gian: unknown key"),
        ("film_gain = nan\n", "film_gain"),
        ("[film_input]\nmains_frequency_Hz = -1\n", "film_input.mains_frequency_Hz = -1"),
        ("film = \n", "world.toml"),
    ],
)
def test_wrong_world_settings_are_refused(tmp_path: Path, text: str, reported: str) -> None:
    path = tmp_path / "world.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_world(str(path))
    assert reported in caught.value.message


def test_missing_world_settings_are_refused_and_none_are_the_defaults(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        read_world(str(tmp_path / "none.toml"))
    assert read_world(None) == WorldSettings()


# --- fault plans -----------------------------------------------------------------------------


def with_fault(tmp_path: Path, **fault: object) -> tuple[World, Path]:
    """A World with one fault, and where its log is."""
    plan = FaultPlan.model_validate({"fault": [fault]})
    log = tmp_path / "world.jsonl"
    settings = WorldSettings.model_validate(SILENT)
    return World(settings, 3, slaved=True, log=log, faults=plan.of(TimedFault)), log


def pass_time(of: World, step_us: int = 10_000, steps: int = 1) -> None:
    for _ in range(steps):
        of.timeline.advance(step_us)
        of.settle()


def injected(log: Path) -> list[tuple[int, str, str]]:
    said = [json.loads(line) for line in log.read_text().splitlines()]
    return [(x["t_us"], x["device"], x["value"]) for x in said if x["what"] == "injected"]


def test_a_spike_comes_so_long_after_its_acquisition_began(tmp_path: Path) -> None:
    of, log = with_fault(
        tmp_path, device="force_sensor", kind="spike", acquisition=2, after_s=0.004,
        for_s=0.003, force_N=12.0,
    )  # fmt: skip
    of.begin_acquisition()
    pass_time(of, steps=3)
    assert injected(log) == []
    of.begin_acquisition()
    pass_time(of)
    times = 0.0305 + np.arange(10) * 1e-3
    pushed = of.force_N(times)[:, 2] - of.force_N(np.array([0.0]))[0, 2]
    assert pushed.tolist() == [0.0] * 4 + [12.0] * 3 + [0.0] * 3
    assert injected(log) == [(40_000, "force_sensor", "spike")]


def test_a_fault_without_an_acquisition_comes_at_its_bench_time(tmp_path: Path) -> None:
    of, _ = with_fault(tmp_path, device="daq", kind="overrun", after_s=0.025)
    heard: list[int] = []
    of.on_fault("daq", lambda fault, t_us: heard.append(t_us))
    pass_time(of, steps=2)
    assert heard == []
    pass_time(of, steps=3)
    assert heard == [25_000]


def test_a_clipped_amplitude_stays_clipped_whatever_is_asked_for(tmp_path: Path) -> None:
    of, _ = with_fault(tmp_path, device="generator", kind="clipped", after_s=1.0, amplitude_V=0.5)
    drive(of, 1.0)
    pass_time(of, 999_000)
    whole = np.ptp(sampled(of, at_us=900_000)[:, 0])
    pass_time(of, 500_000, steps=2)
    assert np.ptp(sampled(of, at_us=1_900_000)[:, 0]) == pytest.approx(whole / 2, rel=1e-3)
    drive(of, 5.0)
    pass_time(of, 500_000, steps=2)
    assert np.ptp(sampled(of, at_us=2_900_000)[:, 0]) == pytest.approx(whole / 2, rel=1e-3)
    drive(of, 0.25)
    pass_time(of, 500_000, steps=2)
    assert np.ptp(sampled(of, at_us=3_900_000)[:, 0]) == pytest.approx(whole / 4, rel=1e-3)


def test_a_clock_that_jumps_continues_from_there(tmp_path: Path) -> None:
    of, _ = with_fault(tmp_path, device="clock", kind="clock-jump", after_s=0.015, by_s=2.0)
    pass_time(of)
    assert of.now_us == 10_000
    pass_time(of)
    assert of.now_us == 2_020_000
    pass_time(of)
    assert of.now_us == 2_030_000


@pytest.mark.parametrize(
    ("kind", "keys", "sensed"),
    [
        ("dead-noisy", {}, [0.0, 0.0, 0.0]),
        ("wrong-scale", {"factor": 0.1}, [0.1, 0.2, 0.3]),
        ("drift", {"axis": "y", "rate_N_s": -2.0}, [1.0, 2.0 - 0.02, 3.0]),
    ],
)
def test_a_faulty_sensor_does_not_sense_the_force_that_acts(
    tmp_path: Path, kind: str, keys: dict[str, Any], sensed: list[float]
) -> None:
    of, _ = with_fault(tmp_path, device="force_sensor", kind=kind, after_s=0.02, **keys)
    of.weigh((1.0, 2.0, -22.0))  # the film, where no stage is mounted, presses with 25 N
    pass_time(of, steps=3)
    before, after = of.force_N(np.array([0.01, 0.03]))
    assert before == pytest.approx([1.0, 2.0, 3.0])
    assert after == pytest.approx(sensed)


def test_a_film_can_be_given_a_gain_that_grows_with_the_load() -> None:
    """0.1 dB/decade about 1 N, in the film's channel alone."""
    linear = world(**SILENT)
    bent = world(clamp={"gain_per_load_decade_dB": 0.1}, **SILENT)
    ratios = []
    for amplitude in (0.1, 1.0, 5.0):
        volts = []
        for bench in (linear, bent):
            drive(bench, amplitude)
            volts.append(np.ptp(sampled(bench, at_us=2_000_000), axis=0) / 2)
        assert volts[0][0] == pytest.approx(volts[1][0], rel=1e-12)
        load_N = volts[0][0] / 0.1
        ratios.append(20 * np.log10(volts[1][1] / volts[0][1]) - 0.1 * np.log10(load_N))
    assert ratios == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)


def test_the_world_tells_the_film_that_it_put_in() -> None:
    reported = world(film="nominal").truth()["film"]
    assert reported["drops_Hz"] == [500.0, 2400.0, 9000.0]
    assert reported["corner_Hz"] == pytest.approx(2000.0, rel=0.01)
    assert reported["gain_per_load_decade_dB"] == 0
    assert world(film="open-circuit").truth() == {}

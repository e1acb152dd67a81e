"""What the skin model costs and how far its figures depend on mesh and step: tables, no judgement.

./run pytest -n 0 -s -m benchmark tests/benchmarks/bench_skin.py
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
from measured import heading

from rig.core.cache import DiskCache
from rig.physics.contact.settings import ContactSettings, FrictionSettings, Plate
from rig.physics.contact.stepper import ContactStepper
from rig.physics.design_map import MapSettings, design_map
from rig.physics.loading_history import RELIEFS, HistorySettings, run_history
from rig.physics.skin.condensed import CondensedSkin, build_skin, condense
from rig.physics.skin.elasticity import ElasticSkin, strip_areas
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import SampleSettings, SkinTrial, SlideSettings, high_frequency, slide

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> DiskCache:
    heading("the skin model: cost, and its figures against mesh, step and friction")
    return DiskCache(tmp_path_factory.mktemp("skins"))


def timed(act: Callable[[], object], repeats: int = 5) -> tuple[float, float, float]:
    """Median, least and largest time of `repeats` calls, s."""
    seen = []
    for _ in range(repeats):
        start = time.perf_counter()
        act()
        seen.append(time.perf_counter() - start)
    return statistics.median(seen), min(seen), max(seen)


def show(name: str, times: tuple[float, float, float]) -> None:
    middle, least, largest = (1e3 * t for t in times)
    print(f"{name:44s} {middle:9.1f} ms  ({least:.1f} .. {largest:.1f})")


def warm(skin: CondensedSkin) -> None:
    ContactStepper(skin, ContactSettings(), Plate()).advance(np.full(3, 1.0), 0.0)


def hf_peak(trial: SkinTrial) -> tuple[float, float, float]:
    """|v_d| above 100 Hz in mV: at the step rate; least and largest over the sampling phases."""
    step = float(trial.time_s[1] - trial.time_s[0])
    end = trial.truth.whole_slip_s[2] + 0.02
    end = end if np.isfinite(end) else trial.time_s[-1]
    window = (trial.time_s > trial.motion_s + 0.01) & (trial.time_s < end)
    fine = np.abs(high_frequency(trial.filtered_v_d, 1 / step))[window].max() * 1e3
    every = round(1e-3 / step)
    phases = [
        np.abs(high_frequency(trial.filtered_v_d[p::every], 1000.0))[window[p::every]].max() * 1e3
        for p in range(every)
    ]
    return float(fine), float(min(phases)), float(max(phases))


def test_build(cache: DiskCache):
    """Budget: 1 s cold, 50 ms from the cache, at 6 elements a ridge."""
    settings = SkinSettings(elements_per_ridge=6)
    start = time.perf_counter()
    condense(SkinSettings(ridges=1, elements_per_ridge=2))
    print(f"\nfirst use in a process (imports): {time.perf_counter() - start:.2f} s")
    show("build at 6 elements, cold", timed(lambda: condense(settings)))
    build_skin(settings, cache)
    show("build at 6 elements, from the cache", timed(lambda: build_skin(settings, cache)))


def test_contact_steps_a_second(cache: DiskCache):
    """Budget: 25 000 steps/s at 6 elements a ridge."""
    skin = build_skin(SkinSettings(elements_per_ridge=6), cache)
    start = time.perf_counter()
    warm(skin)
    print(
        f"\nfirst step in a process (compilation or its cache): {time.perf_counter() - start:.2f} s"
    )
    force = np.concatenate([2 - 2 * np.cos(np.pi * np.arange(1, 3001) / 3000), np.full(5500, 4.0)])
    x = np.concatenate([np.zeros(4500), 5e-5 * np.arange(4000)])
    phases = {
        "loading and rest": slice(0, 4500),
        "shear until ridge 2 slips": slice(4500, 6200),
        "ridges slip": slice(6200, 7700),
        "gross slip": slice(7700, 8500),
        "the whole slide": slice(0, 8500),
    }
    for name, part in phases.items():
        stepper = ContactStepper(skin, ContactSettings(), Plate())
        if part.start:
            stepper.advance(force[: part.start], x[: part.start])
        state = stepper.state

        def run(stepper=stepper, state=state, part=part) -> None:
            stepper.state = state
            stepper.advance(force[part], x[part])

        middle, least, largest = timed(run, 7)
        count = part.stop - part.start
        rates = [count / t for t in (middle, largest, least)]
        print(f"{name:28s} {rates[0]:9.0f} steps/s  ({rates[1]:.0f} .. {rates[2]:.0f})")
    stepper = ContactStepper(skin, ContactSettings(), Plate())
    stepper.advance(force[:6000], x[:6000])
    places = iter(x[6000:] + 0.0)
    show(
        "one step a call (100 calls)",
        timed(lambda: [stepper.advance(4.0, next(places)) for _ in range(100)]),
    )


def test_cost_against_mesh(cache: DiskCache):
    """Each part's cost and its growth exponent from the mesh before."""
    print("\nelements  nodes   dofs | assemble   factor    solve    rows |  step µs (all slip)")
    before: tuple[int, list[float]] | None = None
    for n in (4, 6, 8, 12, 16):
        settings = SkinSettings(elements_per_ridge=n)
        marks = [time.perf_counter()]
        elastic = ElasticSkin(settings)
        _ = elastic.stiffness
        marks.append(time.perf_counter())
        _ = elastic._factor
        marks.append(time.perf_counter())
        _ = elastic.influence
        marks.append(time.perf_counter())
        areas = [a for ridge in range(settings.ridges) for a in strip_areas(settings, ridge)]
        _ = elastic.mean_stress_rows(areas) @ elastic.influence
        marks.append(time.perf_counter())
        skin = build_skin(settings, cache)
        warm(skin)
        stepper = ContactStepper(skin, ContactSettings(), Plate())
        stepper.advance(np.linspace(0.01, 4, 200), 0.0)
        stepper.advance(np.full(2000, 4.0), 2e-4 * np.arange(1, 2001))
        state = stepper.state

        def slip(stepper=stepper, state=state) -> None:
            stepper.state = state
            stepper.advance(np.full(500, 4.0), 0.4 + 2e-4 * np.arange(1, 501))

        costs = [*np.diff(marks), timed(slip)[0] / 500]
        print(
            f"{n:8d} {skin.nodes:6d} {elastic.free.size:6d} | "
            + "  ".join(f"{c * 1e3:7.0f}" for c in costs[:4])
            + f" | {costs[4] * 1e6:8.1f}",
            end="",
        )
        if before is not None:
            growth = [
                np.log(now / then) / np.log(n / before[0])
                for now, then in zip(costs, before[1], strict=True)
            ]
            print("   exponents " + " ".join(f"{g:4.1f}" for g in growth), end="")
        print()
        before = (n, costs)


def test_figures_against_mesh(cache: DiskCache):
    """HF peak and slip times from 4 to 16 elements a ridge, graded and uniform."""
    for refinement in ("graded", "uniform"):
        print(
            f"\n{refinement}: elements | HF peak mV at step rate (1 kHz: least..most over phases) |"
        )
        print(
            "  impulse mV | hump mV | whole slip of ridges 1-9, s | gross slip s | most sets tried"
        )
        for n in (4, 6, 8, 12, 16):
            skin = build_skin(SkinSettings(elements_per_ridge=n, refinement=refinement), cache)
            trial = slide(skin, SlideSettings())
            fine, least, most = hf_peak(trial)
            v_d = trial.filtered_v_d * 1e3
            truth = trial.truth
            steady = (trial.time_s > 0.52) & (trial.time_s < truth.whole_slip_s[1] - 0.02)
            print(
                f"{n:4d} | {fine:5.2f} ({least:5.2f} .. {most:5.2f}) | {v_d.min():6.2f} | "
                f"{np.median(v_d[steady]):5.2f} | {np.round(truth.whole_slip_s, 4)} | "
                f"{truth.gross_slip_s:.4f} | {trial.block.iterations.max():.0f}"
            )


def test_figures_against_step(cache: DiskCache):
    """HF peak against the time step, 8 elements a ridge."""
    skin = build_skin(SkinSettings(), cache)
    print("\nstep µs | HF peak mV at step rate (1 kHz phases) | whole slip of ridge 3, s")
    for step_us in (1000.0, 500.0, 250.0, 100.0, 50.0, 25.0):
        settings = SlideSettings(
            contact=ContactSettings(step_us=step_us), sample=SampleSettings(filter_Hz=400.0)
        )
        trial = slide(skin, settings)
        fine, least, most = hf_peak(trial)
        print(f"{step_us:6.0f} | {fine:5.2f} ({least:5.2f} .. {most:5.2f}) | ", end="")
        print(f"{trial.truth.whole_slip_s[2]:.5f}")


def test_figures_against_friction(cache: DiskCache):
    """HF peak against μ_k/μ_s and D_c on the converged and on the uniform mesh."""
    for refinement, n in (("graded", 6), ("graded", 12), ("uniform", 6)):
        skin = build_skin(SkinSettings(elements_per_ridge=n, refinement=refinement), cache)
        print(f"\n{refinement}, {n} elements: HF peak mV at D_c 1, 3, 10, 30 µm")
        for ratio in (0.7, 0.85, 0.95):
            peaks = []
            for distance in (1.0, 3.0, 10.0, 30.0):
                friction = FrictionSettings(
                    kinetic_coefficient=0.8 * ratio, weakening_distance_um=distance
                )
                contact = ContactSettings(friction=friction)
                peaks.append(hf_peak(slide(skin, SlideSettings(contact=contact)))[0])
            print(f"  μ_k/μ_s {ratio:4.2f}: " + "  ".join(f"{p:6.2f}" for p in peaks))


def test_loading_history():
    """Budget: 2 s."""
    print()
    for name, loads in RELIEFS.items():
        settings = HistorySettings(loads=loads)
        show(f"4.2 history, {name}", timed(lambda s=settings: run_history(s), 3))


def test_design_map():
    print()
    show("design map, 20 places in 9 ridges", timed(lambda: design_map(MapSettings()), 3))

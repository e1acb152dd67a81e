"""The skin above its plate: forces, volts and slips are the model's, whoever asks when."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import mostly_thorough

from drivers.simulated.bench.control import ControlServer
from drivers.simulated.faults.plan import STAGE_X, STAGE_Z
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive
from drivers.simulated.world import skin_contact
from drivers.simulated.world.axis import AxisCommand, AxisEvent
from drivers.simulated.world.plate_world import PlateWorldSettings, mount_skin
from drivers.simulated.world.settings import WorldSettings, read_world
from drivers.simulated.world.world import World
from rig.core.cache import DiskCache
from rig.core.errors import ConfigurationError
from rig.physics.contact.settings import ContactSettings, Plate
from rig.physics.contact.stepper import (
    ContactBlock,
    ContactStepper,
    ConvergenceError,
)
from rig.physics.contact.truth import SlipWatch
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.transducer import TransducerChain, TransducerSettings

QUIET = {"noise_density_V_sqrtHz": 0.0, "mains_amplitude_mV": 0.0}
CONTACT_mm = 12.4
STEP_us = 100
EXACT_N = 1e-9
"""What an inverse that was updated differently may cost; a node carries up to 0.1 N."""
EXACT_V = 1e-9
"""The same behind the amplifier: 1e-9 N on 8 mm2, differentiated in 0.1 ms, times 1000."""


@pytest.fixture(autouse=True)
def cached(monkeypatch: pytest.MonkeyPatch, skin_cache: DiskCache, skin6: CondensedSkin) -> None:
    """The World finds its skin where these tests keep it."""
    monkeypatch.setenv("RIG_CACHE", str(skin_cache.folder))


class Hung:
    """A World with the skin above its plate on two drives, and a hand that moves them."""

    def __init__(self, log: Path | None = None, **settings: Any):
        own = {"skin": {"elements_per_ridge": 6}, "strip_input": QUIET, **settings}
        chosen = PlateWorldSettings.model_validate(own)
        self.world = World(chosen, 0, slaved=True, log=log)
        self.z = CmmtDrive(SimulatedCmmtSettings(name=STAGE_Z), self.world)
        self.x = CmmtDrive(SimulatedCmmtSettings(name=STAGE_X), self.world)
        mount_skin(self.world, chosen, self.z, self.x)

    @property
    def now_us(self) -> int:
        return self.world.now_us

    def go(self, drive: CmmtDrive, target_mm: float, speed_mm_s: float) -> None:
        """Begin to move."""
        drive.axis.move(self.now_us, AxisCommand(target_mm, speed_mm_s, 200.0, 200.0))

    def run(self, seconds: float, step_us: int = 10_000) -> None:
        """Let time pass as a slaved bench does."""
        end = self.now_us + round(seconds * 1e6)
        while self.now_us < end:
            self.world.timeline.advance(min(step_us, end - self.now_us))
            self.z.settle(self.now_us)
            self.x.settle(self.now_us)
            self.world.settle()

    def press(self, approach_mm: float, step_us: int = 10_000) -> None:
        """Come down and rest."""
        self.go(self.z, CONTACT_mm - 0.05, 20.0)
        self.run(0.3, step_us)
        self.go(self.z, CONTACT_mm + approach_mm, 1.0)
        self.run(0.3, step_us)

    def force(self) -> np.ndarray:
        """Force on the plate, now."""
        return self.world.force_N(np.array([self.now_us * 1e-6]))[0]

    def volts(self, first_us: int, count: int, rate: float = 20e3) -> np.ndarray:
        """What the strips' terminals carried from `first_us` on."""
        number = self.world.begin_acquisition()
        return self.world.volts(number, (101, 102), first_us, rate, 0, count, (0.0, 0.0))

    def model(self, skin: CondensedSkin) -> tuple[ContactBlock, np.ndarray]:
        """The pure model under the motion that was: one block from the first step on."""
        times = np.arange(0, self.now_us + 1, STEP_us)
        approach = self.z.positions_mm(times) - CONTACT_mm
        x = self.x.positions_mm(times)
        stepper = ContactStepper(skin, ContactSettings(), Plate(), position_mm=float(x[0]))
        block = stepper.advance(approach, x, normal_control="position")
        chain = TransducerChain(TransducerSettings(), STEP_us * 1e-6)
        return block, chain.advance(block.stress_MPa[:, :, 1])


def approach_of(skin: CondensedSkin, force_N: float) -> float:
    """How deep a plate of this force sinks in."""
    stepper = ContactStepper(skin, ContactSettings(), Plate())
    return float(stepper.advance(np.linspace(0, force_N, 2000), 0.0).approach_mm[-1])


@pytest.fixture(scope="module")
def four_newton_mm(skin6: CondensedSkin) -> float:
    """The approach at 4 N."""
    return approach_of(skin6, 4.0)


def test_pressed_with_four_newtons_all_nine_ridges_carry_what_the_sensor_feels(
    skin6: CondensedSkin, four_newton_mm: float
) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    block, _ = hung.model(skin6)
    ridges = block.ridge_normal_N[-1]
    assert (ridges > 0).all()
    force = hung.force()
    assert force[2] == pytest.approx(ridges.sum(), abs=EXACT_N)
    assert force[2] == pytest.approx(4.0, rel=0.01), "friction in between differs a little"
    assert force[0] == pytest.approx(0.0, abs=1e-6), "the skin is even"
    assert force[1] == 0.0


def test_a_slide_is_the_models_slide(skin6: CondensedSkin, four_newton_mm: float) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    begin = hung.now_us
    hung.go(hung.x, 11.0, 0.5)
    hung.run(0.4)
    block, volts = hung.model(skin6)
    ends = np.arange(begin, hung.now_us + 1, STEP_us)
    done = ends // STEP_us - 1  # the step that ends there
    force = hung.world.force_N(ends * 1e-6)
    assert force[:, 2] == pytest.approx(block.normal_force_N[done], abs=EXACT_N)
    assert force[:, 0] == pytest.approx(block.tangential_force_N[done], abs=EXACT_N)
    assert force[-1, 0] > 2.0, "the plate is dragged towards +x, where the stage goes"
    sampled = hung.volts(begin, 8000, 20e3)
    assert sampled[::2] == pytest.approx(volts[done][:4000], abs=EXACT_V)
    assert sampled[1:-1:2] == pytest.approx((sampled[:-2:2] + sampled[2::2]) / 2, abs=1e-12)
    assert np.ptp(sampled[:, 0] - sampled[:, 1]) > 0.01, "ridge 3 slipped"


def test_the_record_of_slips_is_the_models(skin6: CondensedSkin, four_newton_mm: float) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    begin = hung.now_us
    hung.go(hung.x, 11.0, 0.5)
    hung.run(0.5)
    truth = hung.world.truth()
    block, _ = hung.model(skin6)
    touched = (block.status != 0).any(axis=1)
    assert truth["touch_down_us"] == [(int(touched.argmax()) + 1) * STEP_us]
    assert truth["lift_off_us"] == []
    assert truth["slide_us"] == begin + STEP_us, "the first step from where the stage has moved"
    watch = SlipWatch(skin6.ridge, STEP_us * 1e-6)
    first = truth["slide_us"] // STEP_us
    watch.add(block.status[first:])
    model = watch.truth()
    whole = [truth["slide_us"] + round(at * 1e6) for at in model.whole_slip_s]
    assert truth["whole_slip_us"] == whole
    order = sorted(range(1, 10), key=lambda ridge: whole[ridge - 1])
    assert order == [1, 9, 2, 3, 8, 4, 7, 5, 6], "the reference slide's"
    assert truth["first_slip_us"][2] == truth["slide_us"] + round(model.first_slip_s[2] * 1e6)
    assert truth["gross_slip_us"] == truth["slide_us"] + round(model.gross_slip_s * 1e6)
    assert (truth["static_coefficient"], truth["kinetic_coefficient"]) == (0.8, 0.65)


def slid(
    step_us: int, curious: bool = False, force_limit_N: float = 200.0
) -> tuple[bytes, bytes, dict[str, Any]]:
    """Both stages moved at once, in touch, out of it and into it again."""
    hung = Hung(skin_mount={"jitter_um": 0.2, "jitter_Hz": 70.0})
    hung.x.axis.force_limit_N = force_limit_N
    hung.run(0.0123, step_us)
    hung.press(0.03, step_us)
    hung.go(hung.x, 10.3, 1.0)
    hung.run(0.1, step_us)
    if curious:
        hung.force()
        hung.volts(hung.now_us - 5_000, 30)
        hung.world.truth()
    hung.go(hung.z, CONTACT_mm + 0.04, 0.2)  # while x is moving
    hung.run(0.15, step_us)
    hung.go(hung.z, CONTACT_mm - 0.05, 5.0)
    hung.run(0.1, step_us)
    hung.go(hung.z, CONTACT_mm + 0.02, 1.0)
    hung.go(hung.x, 10.0, 0.7)
    hung.run(0.2, step_us)
    times = np.arange(0, hung.now_us, 130) * 1e-6
    return (
        hung.world.force_N(times).tobytes(),
        hung.volts(0, 20_000).tobytes(),
        hung.world.truth(),
    )


@pytest.mark.parametrize(
    "force_limit_N",
    mostly_thorough([200.0, 0.7], default=[0.7]),
    ids=["strong", "held by friction"],
)
def test_the_same_bits_whatever_the_lengths_of_the_advances_and_whoever_asks(
    force_limit_N: float,
) -> None:
    slaved = slid(10_000, force_limit_N=force_limit_N)
    assert slid(1_000, force_limit_N=force_limit_N) == slaved
    assert slid(3_700, curious=True, force_limit_N=force_limit_N) == slaved


def test_lifted_off_it_bears_nothing_and_a_second_touch_is_a_fresh_one(
    skin6: CondensedSkin, four_newton_mm: float
) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    hung.go(hung.x, 11.0, 0.5)
    hung.run(0.3)
    hung.go(hung.z, 12.0, 5.0)
    hung.run(0.3)
    assert (hung.force() == 0).all()
    assert not hung.volts(hung.now_us - 50_000, 1000).any()
    hung.run(3.0)  # x arrives
    hung.press(four_newton_mm)
    fresh = Hung()
    fresh.press(four_newton_mm)
    assert hung.force()[2] == pytest.approx(fresh.force()[2], abs=EXACT_N)
    truth = hung.world.truth()
    assert len(truth["touch_down_us"]) == 2
    (lifted,) = truth["lift_off_us"]
    assert truth["touch_down_us"][0] < lifted < truth["touch_down_us"][1]
    assert truth["slide_us"] is None, "the second touch has not slid"


def test_a_new_point_forgets_what_happened_before_it(four_newton_mm: float) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    hung.go(hung.x, 10.25, 0.5)
    hung.run(0.7)
    assert hung.world.truth()["gross_slip_us"] is not None
    hung.world.announce(0, 7)
    truth = hung.world.truth()
    assert truth["since_us"] == hung.now_us
    assert (truth["touch_down_us"], truth["slide_us"], truth["gross_slip_us"]) == ([], None, None)
    hung.go(hung.x, 9.0, 0.5)
    hung.run(0.9)
    back = hung.world.truth()
    assert back["touch_down_us"] == [], "it touched before"
    assert back["gross_slip_us"] > back["slide_us"] > truth["since_us"]


def test_the_stages_feel_the_plate(four_newton_mm: float) -> None:
    hung = Hung()
    hung.press(four_newton_mm)
    hung.go(hung.x, 11.0, 0.5)
    hung.run(1.0)
    tangential, _, normal = hung.force()
    for drive, force in ((hung.x, tangential), (hung.z, normal)):
        name, at_mm = drive.settings.name, drive.position_mm(hung.now_us)
        assert hung.world.load_N(name, at_mm, hung.now_us) == pytest.approx(-force, abs=1e-3)
    assert tangential == pytest.approx(0.65 * normal, rel=0.01), "all of it slips"


@pytest.mark.parametrize("stage", [STAGE_X, STAGE_Z])
def test_a_stage_too_weak_for_the_contact_is_held_by_it(stage: str, four_newton_mm: float) -> None:
    hung = Hung()
    drive = hung.x if stage == STAGE_X else hung.z
    drive.axis.force_limit_N = 1.5
    drive.axis.seeks_fixed_stop = True
    hung.press(four_newton_mm if stage == STAGE_X else 0.2)
    hung.go(hung.x, 11.0, 0.5)
    hung.run(0.5)
    felt = hung.force()[0 if stage == STAGE_X else 2]
    assert drive.axis.happenings(hung.now_us) == [], "the drive has seen what it met"
    fixed = drive.read(100, 28, "test")[3] >> 8 & 1
    assert fixed, f"{AxisEvent.FIXED_STOP.value} is shown"
    assert 1.4 < felt < 1.7, "1.5 N, found within a millisecond"


def test_a_stage_that_jitters_drags_the_plate_but_has_not_begun_to_slide() -> None:
    hung = Hung(skin_mount={"jitter_um": 0.3, "jitter_Hz": 100.0})
    hung.press(0.04)
    times = np.arange(hung.now_us - 20_000, hung.now_us, STEP_us) * 1e-6
    dragged = hung.world.force_N(times)[:, 0]
    assert 0.001 < np.ptp(dragged) < 0.5
    assert hung.world.truth()["slide_us"] is None


def test_the_strips_amplifiers_clip(four_newton_mm: float) -> None:
    circuit = {**TransducerSettings().circuit.model_dump(), "gain": 1e7}
    hung = Hung(transducer={"circuit": circuit})
    hung.press(four_newton_mm)
    volts = hung.volts(0, round(hung.now_us * 20e-3))
    assert np.abs(volts).max() == 10.0


def test_a_history_that_forgets_still_tells_the_present(
    monkeypatch: pytest.MonkeyPatch, four_newton_mm: float
) -> None:
    def reported() -> bytes:
        hung = Hung()
        hung.press(four_newton_mm)
        hung.go(hung.x, 11.0, 0.5)
        hung.run(0.3377, 13_000)
        times = np.arange(hung.now_us - 9_000, hung.now_us, 30) * 1e-6
        return hung.world.force_N(times).tobytes() + hung.volts(hung.now_us - 9_000, 180).tobytes()

    whole = reported()
    monkeypatch.setattr(skin_contact, "KEPT_s", 0.02)
    assert reported() == whole


def test_the_log_tells_touch_slips_and_lift_off(tmp_path: Path, four_newton_mm: float) -> None:
    path = tmp_path / "world.jsonl"
    hung = Hung(path)
    hung.press(four_newton_mm)
    hung.go(hung.x, 11.0, 0.5)
    hung.run(0.5)
    hung.go(hung.z, 12.0, 5.0)
    hung.run(0.3)
    said = [json.loads(line) for line in path.read_text().splitlines()]
    slips = [entry["value"] for entry in said if entry["what"] == "slip"]
    truth = hung.world.truth()
    assert {slip["ridge"]: slip["at_us"] for slip in slips} == dict(
        enumerate(truth["whole_slip_us"], start=1)
    )
    named = [entry["what"] for entry in said if entry["what"] != "slip"]
    assert named == ["touch-down", "gross-slip", "lift-off"]


def test_truth_is_asked_for_at_the_control_socket() -> None:
    hung = Hung()
    hung.press(0.02)
    plate, clamp = (
        ControlServer(world, {}, lambda: None, lambda: None, lambda: None)
        for world in (hung.world, World(WorldSettings(), 0, slaved=True))
    )
    assert plate.answer(b'{"do": "truth"}') == {"now_us": hung.now_us, **hung.world.truth()}
    reported = clamp.answer(b'{"do": "truth"}')
    assert set(reported) == {"now_us", "film"}, (
        "of a film, what it is; it keeps no record of events"
    )


def test_a_step_without_a_solution_is_never_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "world.jsonl"
    hung = Hung(path)
    hung.press(0.02)
    held = hung.force()

    def fails(*_: object, **__: object) -> ContactBlock:
        raise ConvergenceError("contact step 1 of 10 found no consistent set")

    monkeypatch.setattr(ContactStepper, "advance", fails)
    control = ControlServer(
        hung.world, {}, lambda: None, lambda: None, lambda: None, lambda: hung.world.settle()
    )
    advance = b'{"do": "advance", "us": 10000}'
    answer = control.answer(advance)
    assert "no consistent set" in answer["error"]
    assert f"after {hung.now_us - 10_000 + STEP_us} us" in answer["error"]
    assert "contact-failed" in path.read_text()
    assert "error" not in control.answer(advance), "the bench has still to be brought to rest"
    assert hung.force() == pytest.approx(held, abs=1e-6), "where it stood"
    assert "no consistent set" in control.answer(b'{"do": "truth"}')["error"]
    assert "no consistent set" in control.answer(b'{"do": "point", "run": 0, "point": 1}')["error"]


def test_a_step_that_does_not_fit_the_stages_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"contact\.step_us 300 us"):
        Hung(contact={"step_us": 300})


def test_a_ridge_that_the_skin_has_not_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="ridge"):
        Hung(skin_mount={"ridge": 10})


def test_settings_of_the_skin_are_refused_where_a_film_is_clamped(tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text("[skin_mount]\njitter_um = 0.1\n")
    assert read_world(str(path), PlateWorldSettings).skin_mount.jitter_um == 0.1
    with pytest.raises(ConfigurationError, match="skin_mount: unknown key"):
        read_world(str(path))


def test_unequal_gains_scale_the_strips_against_each_other() -> None:
    volts = {}
    for mismatch in (0.0, 0.1):
        hung = Hung(skin_mount={"gain_mismatch": mismatch})
        hung.press(0.05)
        volts[mismatch] = hung.volts(hung.now_us - 200_000, 4000)
    assert np.abs(volts[0.0]).max() > 1e-4
    np.testing.assert_allclose(volts[0.1], volts[0.0] * [1.05, 0.95])


def test_each_slip_of_the_watched_ridge_is_recorded_with_its_end(four_newton_mm: float) -> None:
    """Two slides with a stop between them, in which the skin sticks under full shear."""
    hung = Hung()
    hung.press(four_newton_mm)
    begin_mm = float(hung.x.positions_mm(np.array([hung.now_us]))[0])
    stops = []
    for way_mm in (0.3, 0.6):
        hung.go(hung.x, begin_mm + way_mm, 1.0)
        hung.run(0.5)
        stops.append(hung.now_us)
    truth = hung.world.truth()
    first, second = truth["ridge_slip_begins_us"]
    assert first == truth["whole_slip_us"][2]
    assert first < truth["ridge_slip_ends_us"][0] < stops[0] < second
    assert second < truth["ridge_slip_ends_us"][1] < stops[1]

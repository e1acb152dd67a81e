"""The force servo: closed forms on a spring, and the simulated skin at the corners of its range."""

from __future__ import annotations

import math
from collections.abc import Callable, Container

import numpy as np
import pytest
from pressed_skin import press_and_slide

from drivers.simulated.world.axis import AxisCommand, Mechanics, SimulatedAxis
from rig.control.approach import (
    Approach,
    ContactStiffness,
    STIFFEST_N_mm,
    closing_speed_mm_s,
)
from rig.control.force_servo import ContactShift, ForceServo, settings_from
from rig.control.speed_bound import largest_speed_mm_s
from rig.physics.contact.settings import FrictionSettings
from rig.physics.skin.condensed import CondensedSkin

TARGET_N, STIFFNESS_N_mm = 4.0, 160.0


def on_a_spring(
    disturbance_N: Callable[[float], float],
    *,
    ticks: int = 400,
    tick_s: float = 0.01,
    truth: float = 1.0,
    left_out: Container[int] = (),
    knows_of_it: bool = True,
) -> np.ndarray:
    """Force at each tick on a spring `truth` times as stiff as the servo thinks; the axis is there
    at once and is seen a whole number of ticks later: a delay of half a tick less. The servo steps
    at no tick that is `left_out`, which it learns with the next."""
    late = 1 if tick_s > 0.005 else 3
    servo = ForceServo(settings_from(TARGET_N, STIFFNESS_N_mm, tick_s, (late - 0.5) * tick_s, 1e6))
    commanded = [0.0] * late
    forces = []
    missed = 0
    for k in range(ticks):
        force = TARGET_N + disturbance_N(k * tick_s) + truth * STIFFNESS_N_mm * commanded[-late]
        forces.append(force)
        if k in left_out:
            missed += knows_of_it
        else:
            servo.step(force, 1 + missed)
            missed = 0
        commanded.append(servo.commanded_mm)
    return np.array(forces)


@pytest.mark.parametrize("tick_s", [0.01, 0.002])
@pytest.mark.parametrize("truth", [0.5, 1.0, 1.3])
def test_a_step_and_a_ramp_leave_no_error(tick_s: float, truth: float) -> None:
    """Also where the stiffness is half or 1.3 times the one assumed."""
    after_step = on_a_spring(lambda t: 0.3, tick_s=tick_s, truth=truth)
    assert np.abs(after_step[-100:] - TARGET_N).max() < 1e-3
    after_ramp = on_a_spring(lambda t: 5.0 * t, tick_s=tick_s, truth=truth)
    # what half a tick of the ramp is, for the command is right in its middle
    assert np.abs(after_ramp[-100:] - TARGET_N).max() < 0.51 * 5.0 * tick_s


@pytest.mark.parametrize("tick_s", [0.01, 0.002])
@pytest.mark.parametrize("truth", [0.5, 1.0, 1.3])
def test_a_servo_that_was_left_alone_takes_a_ramp_up_where_it_is(
    tick_s: float, truth: float
) -> None:
    """Over 20 ticks, in which nobody holds the force; one that does not know of them takes what
    has come meanwhile for a steeper ramp, and overshoots."""
    alone = range(200, 220)

    def after(knows_of_it: bool) -> np.ndarray:
        forces = on_a_spring(
            lambda t: 5.0 * t, tick_s=tick_s, truth=truth, left_out=alone, knows_of_it=knows_of_it
        )
        assert forces[219] - TARGET_N > 0.8 * 5.0 * 20 * tick_s
        return forces[225:] - TARGET_N

    overshoot = [-after(commanded).min() / (5.0 * 20 * tick_s) for commanded in (True, False)]
    assert overshoot[0] < 0.7 * overshoot[1]
    assert np.abs(after(True)[-100:]).max() < 0.51 * 5.0 * tick_s


@pytest.mark.parametrize("tick_s", [0.01, 0.002])
def test_every_second_tick_is_enough_for_a_ramp(tick_s: float) -> None:
    forces = on_a_spring(lambda t: 5.0 * t, tick_s=tick_s, left_out=range(1, 400, 2))
    assert np.abs(forces[-100:] - TARGET_N).max() < 2.02 * 5.0 * tick_s


def on_busy_links(knows_of_it: bool, seed: int) -> np.ndarray:
    """Errors of the force in N at 500 Hz on a spring whose force drifts by 5 N/s; a target comes to
    the axis up to 8 ms late, the force is up to 8 ms older than usual, and the servo steps again
    when the axis has answered."""
    rng = np.random.default_rng([56, seed])
    grid_s, tick_s, delay_s = 0.0005, 0.002, 0.004
    servo = ForceServo(settings_from(TARGET_N, STIFFNESS_N_mm, tick_s, delay_s, 1e6))
    felt = delay_s / 2
    axis_mm, orders, free_s, ticks, late_s = [0.0], list[tuple[float, float]](), 0.0, 0, 0.0
    forces = []
    for k in range(4000):
        now_s = k * grid_s
        while orders and orders[0][0] <= now_s:
            axis_mm.append(orders.pop(0)[1])
        axis_mm.append(axis_mm[-1])
        forces.append(TARGET_N + 5.0 * now_s + STIFFNESS_N_mm * axis_mm[-1])
        if k % round(tick_s / grid_s):
            continue
        ticks += 1
        if now_s < free_s:
            continue
        older_s = grid_s * rng.integers(17)
        seen = forces[max(0, len(forces) - 1 - round((felt + older_s) / grid_s))]
        if knows_of_it:
            servo.step(seen, ticks, late_s, older_s)
        else:
            servo.step(seen, ticks)
        late_s, ticks = grid_s * rng.integers(17), 0
        orders.append((now_s + delay_s - felt + late_s, servo.commanded_mm))
        free_s = now_s + 2 * late_s
    return np.array(forces[1000:]) - TARGET_N


def test_a_servo_that_knows_how_late_its_links_are_holds_the_force() -> None:
    """One that does not know it rings: a target comes after the force that it answers to has
    changed."""
    aware, unaware = (
        np.sqrt(np.mean([on_busy_links(knows_of_it, seed) ** 2 for seed in range(8)]))
        for knows_of_it in (True, False)
    )
    assert aware < 0.015 * TARGET_N
    assert unaware > 3 * aware


def test_a_servo_whose_first_force_is_old_begins_with_it() -> None:
    servo = ForceServo(settings_from(TARGET_N, STIFFNESS_N_mm, 0.002, 0.004, 1e6))
    first = servo.step(TARGET_N - 0.05, older_s=0.02)
    assert first.increment_mm == pytest.approx(0.05 / STIFFNESS_N_mm)
    assert servo.step(TARGET_N - 0.05, older_s=0.022).increment_mm == 0.0


def test_one_step_never_asks_for_more_than_the_axis_may_do() -> None:
    settings = settings_from(TARGET_N, STIFFNESS_N_mm, 0.01, 0.005)
    step = ForceServo(settings).step(0.0)
    assert step.increment_mm == pytest.approx(settings.speed_mm_s * 0.01)
    assert step.speed_mm_s == settings.speed_mm_s
    assert settings.speed_mm_s * STIFFNESS_N_mm == pytest.approx(200.0)  # N/s


def test_the_resolution_of_the_axis_does_not_add_up() -> None:
    """A drive rounds each target to a count. Targets are absolute, so the force stays within a
    count although the servo does not know what the drive has made of its commands."""
    unit_mm, k = 1e-3, STIFFNESS_N_mm
    servo = ForceServo(settings_from(TARGET_N, k, 0.01, 0.005, 1e6))
    forces = []
    for _ in range(500):
        counted_mm = round(servo.commanded_mm / unit_mm) * unit_mm
        forces.append(TARGET_N + 0.213 + k * counted_mm)
        servo.step(forces[-1])
    assert np.abs(np.array(forces[-100:]) - TARGET_N).max() <= 1.01 * unit_mm * k


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan"), float("inf")])
def test_a_contact_without_stiffness_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="stiffness_N_mm"):
        settings_from(TARGET_N, wrong, 0.01, 0.005)


def test_the_search_presses_what_it_may() -> None:
    """k (v delay + v^2 / 2a) is the force pressed after touch."""
    for delay_s in (0.005, 0.02):
        v = largest_speed_mm_s(0.4, 166.0, delay_s, 200.0)
        assert 166.0 * (v * delay_s + v**2 / 400.0) == pytest.approx(0.4)


@pytest.mark.parametrize("truth", [0.6, 1.0, 1.4, 2.3])
def test_closing_in_on_a_spring_overshoots_less_than_a_tenth(truth: float) -> None:
    """None up to 1.4 times the stiffness assumed; below 10 % up to 0.58 CLOSING = 2.3 times."""
    dt, delay_s = 1e-4, 0.015
    forces = [0.2] * round(delay_s / dt)
    for _ in range(10_000):
        v = closing_speed_mm_s(TARGET_N - forces[-round(delay_s / dt)], STIFFNESS_N_mm, delay_s)
        forces.append(forces[-1] + truth * STIFFNESS_N_mm * v * dt)
    overshoot = max(forces) / TARGET_N - 1
    assert overshoot < (1e-3 if truth < 1.45 else 0.1)
    assert forces[-1] == pytest.approx(TARGET_N, rel=1e-3)


def test_stiffness_is_found_from_a_force_that_lags() -> None:
    """F = 900 (z)^1.5, pressed ever more slowly, the force 4 ms older than the position."""
    found = ContactStiffness()
    place = lambda t: 0.03 * (1 - np.exp(-t / 0.06))  # noqa: E731
    for k in range(60):
        t = 0.005 * k
        found.add(t, place(t), t - 0.004, 900 * max(place(t - 0.004), 0.0) ** 1.5)
    force = 900 * place(0.291) ** 1.5
    truth = 1.5 * 900 * place(0.291) ** 0.5
    assert found.at_N_mm(force) == pytest.approx(truth, rel=0.05)


@pytest.mark.filterwarnings("error")
def test_a_contact_that_was_seen_at_two_places_only_has_the_slope_between_them() -> None:
    """A stage at rest that is a step of its scale off now and then; a parabola has no bounds."""
    found = ContactStiffness()
    for k in range(60):
        place_mm = 0.001 * (k % 2)
        found.add(0.01 * k, place_mm, 0.01 * k, 1.0 + 40.0 * place_mm)
    assert found.at_N_mm(1.0) == pytest.approx(40.0)


def test_a_stiffness_is_that_of_the_times_and_no_less_than_what_was_pressed_so_far() -> None:
    """Looks that take 30 ms; and points on a slope that no contact has, which stiffens."""
    slow, true_N_mm, speed_mm_s = Approach(20.0, 0.01, 0.005), 150.0, 0.2
    rng = np.random.default_rng(9)
    for t in np.arange(0.0, 0.3, 0.03):
        seen_s, felt_s = t + 0.03 * rng.random(2)
        slow.step(seen_s, speed_mm_s * seen_s, felt_s, true_N_mm * speed_mm_s * (felt_s + 0.01))
    slow.step(0.3, speed_mm_s * 0.3, 0.3, true_N_mm * speed_mm_s * 0.31)
    assert slow.stiffness_N_mm == pytest.approx(true_N_mm, rel=1e-6)
    flat = Approach(4.0, 0.01, 0.005)
    for k, (place_mm, force_N) in enumerate(
        [(0.0, 0.3), (0.01, 1.5), (0.02, 3.0), (0.03, 3.01), (0.06, 3.02), (0.09, 3.03)]
    ):
        flat.step(0.01 * k, place_mm, 0.01 * k, force_N)
    assert flat._stiffness.at_N_mm(3.03) == pytest.approx(1 / 3, rel=0.9)
    assert flat.stiffness_N_mm == pytest.approx(2.73 / 0.09)


def test_nothing_is_said_of_a_contact_that_was_not_felt() -> None:
    assert ContactStiffness().at_N_mm(1.0) is None
    approach = Approach(4.0, 0.01, 0.005)
    step = approach.step(0.0, 0.0, -0.003, 0.01)
    assert not step.touched
    assert step.speed_mm_s == pytest.approx(largest_speed_mm_s(2.0, STIFFEST_N_mm, 0.015, 200.0))


def approached(
    spring_N_mm: float, tick_ms: int, **stated: float
) -> tuple[list[tuple[float, float]], float]:
    """Speed and lead of every step towards `TARGET_N` on a spring, and the largest force in N. A
    command takes 2 ms, a force is 2.5 ms old, and the axis has counts of 0.1 um."""
    axis = SimulatedAxis(Mechanics(start_mm=9.98), lambda position, t: 0.0)
    approach = Approach(TARGET_N, 1e-3 * tick_ms, 0.0045, **stated)
    place_mm = lambda us: axis.position(us) - 10.0  # noqa: E731
    steps, forces, orders = [], [0.0] * 26, []
    arrived_us = math.inf
    for now_us in range(0, 10_000_000, 100):
        if now_us % (1000 * tick_ms) == 0 and now_us < arrived_us:
            here_mm = place_mm(now_us)
            step = approach.step(1e-6 * now_us, here_mm, 1e-6 * now_us - 0.0025, forces[-26])
            steps.append((step.speed_mm_s, step.ahead_mm))
            target_mm = 10.0 + round((here_mm + step.ahead_mm) / 1e-4) * 1e-4
            speed_mm_s = max(step.speed_mm_s, 1e-3)
            orders.append((now_us + 2000, AxisCommand(target_mm, speed_mm_s, 200.0, 200.0)))
            arrived_us = now_us if step.arrived else math.inf
        if orders and orders[0][0] <= now_us:
            axis.move(now_us, orders.pop(0)[1])
        forces.append(max(0.0, spring_N_mm * place_mm(now_us + 100)))
        if now_us > arrived_us + 100_000:
            return steps, max(forces)
    raise AssertionError("it has not arrived")


@pytest.mark.parametrize("tick_ms", [2, 10])
@pytest.mark.parametrize("stiffest_N_mm", [1000.0, 2000.0])
def test_a_contact_as_stiff_as_stated_is_pressed_with_no_more_than_its_force(
    stiffest_N_mm: float, tick_ms: int
) -> None:
    """Also in the first ticks, before its stiffness is known: with 250 N/mm assumed there, the
    force reached 4.6 to 7.6 N."""
    _, largest_N = approached(stiffest_N_mm, tick_ms, stiffest_N_mm=stiffest_N_mm)
    assert largest_N < 1.02 * TARGET_N


@pytest.mark.parametrize("spring_N_mm", [40.0, 160.0, 400.0])
def test_what_is_stated_makes_the_closing_slower_and_never_faster(spring_N_mm: float) -> None:
    """A contact that is softer by its bench file than by its skin must not be pressed too hard. The
    search has always followed what is stated."""
    usual, _ = approached(spring_N_mm, 10)
    stated, _ = approached(spring_N_mm, 10, stiffest_N_mm=STIFFEST_N_mm)
    assert stated == usual
    softer, stiffer = (Approach(TARGET_N, 0.01, 0.0045, stiffest_N_mm=k) for k in (80.0, 1000.0))
    first = [one.step(0.0, 0.0, 0.0, 1.0).speed_mm_s for one in (softer, stiffer)]
    assumed = [closing_speed_mm_s(3.0, k, 0.0145) for k in (STIFFEST_N_mm, 1000.0)]
    assert first == pytest.approx(assumed)
    assert [one.stiffness_N_mm for one in (softer, stiffer)] == [STIFFEST_N_mm, 1000.0]


CORNERS = [(0.3, 2.0), (0.3, 8.0), (1.2, 4.0), (1.2, 8.0)]


@pytest.mark.parametrize(("static", "force_N"), CORNERS)
@pytest.mark.parametrize("ratio", [0.7, 0.95])
def test_the_force_is_held_through_the_fastest_slides(
    skin6: CondensedSkin, static: float, force_N: float, ratio: float
) -> None:
    """At 500 commands a second: 2 % rms, 5 % peak; the approach below 10 %. Decision 0035 has the
    whole table, and where it is missed: 2 N at a friction of 1.2 (6.9 %)."""
    friction = FrictionSettings(static_coefficient=static, kinetic_coefficient=ratio * static)
    held = press_and_slide(skin6, friction, force_N, 6.0, 500)
    assert held.overshoot < 0.02
    assert abs(held.rest) < 0.005
    assert held.rms < 0.02
    assert -0.05 < held.low < held.high < 0.05


@pytest.mark.parametrize(("static", "force_N"), [(0.3, 2.0), (0.8, 4.0), (0.3, 8.0)])
def test_a_hundred_commands_a_second_hold_slower_slides(
    skin6: CondensedSkin, static: float, force_N: float
) -> None:
    friction = FrictionSettings(static_coefficient=static, kinetic_coefficient=0.8 * static)
    held = press_and_slide(skin6, friction, force_N, 3.0, 100)
    assert held.overshoot < 0.02
    assert held.rms < 0.02
    assert -0.05 < held.low < held.high < 0.05


@pytest.mark.parametrize("rate_Hz", [100, pytest.param(500, marks=pytest.mark.thorough)])
@pytest.mark.parametrize(("force_N", "ratio"), [(2.0, 0.95), (4.0, 0.7), (8.0, 0.95)])
def test_a_repeated_slide_is_held_at_any_rate(skin6, rate_Hz, force_N, ratio) -> None:
    """The hardest corners, friction 1.2 at 6 mm/s, once the first slide has shown what comes."""
    friction = FrictionSettings(static_coefficient=1.2, kinetic_coefficient=1.2 * ratio)
    first = press_and_slide(skin6, friction, force_N, 6.0, rate_Hz)
    again = press_and_slide(skin6, friction, force_N, 6.0, rate_Hz, expected=first.shift, seed=1)
    assert again.rms < min(0.02, 0.7 * first.rms)
    assert -0.05 < again.low < again.high < 0.05


def test_a_shift_is_a_broken_line_from_zero() -> None:
    shift = ContactShift()
    assert shift.at_mm(1.0) == 0.0
    for since_s, seen_mm in ((0.0, 0.5), (0.01, 0.503), (0.02, 0.501)):
        shift.add(since_s, seen_mm)
    wanted = {-1.0: 0.0, 0.0: 0.0, 0.005: 0.0015, 0.01: 0.003, 0.015: 0.002, 5.0: 0.001}
    assert {t: shift.at_mm(t) for t in wanted} == pytest.approx(wanted)


@pytest.mark.parametrize("rate_Hz", [100, 500])
@pytest.mark.parametrize("stiffness_error", [0.8, 1.6])
def test_a_wrong_stiffness_does_not_ring(skin6, rate_Hz, stiffness_error) -> None:
    """Held at rest and through the slide as above: ringing would show in both."""
    held = press_and_slide(
        skin6, FrictionSettings(), 4.0, 1.0, rate_Hz, stiffness_error=stiffness_error
    )
    assert abs(held.rest) < 0.005
    assert held.rms < 0.02
    assert -0.05 < held.low < held.high < 0.05


def test_no_move_of_the_servo_is_faster_than_its_bound() -> None:
    settings = settings_from(4.0, 10.0, 0.01, 0.0045, largest_speed_mm_s=1.5)
    servo = ForceServo(settings)
    step = servo.step(force_N=0.5)
    assert step.speed_mm_s == 1.5, "and not 200 N/s on 10 N/mm"
    assert abs(step.increment_mm) <= 1.5 * 0.01


def test_a_new_set_point_is_reached_and_held() -> None:
    servo = ForceServo(settings_from(4.0, STIFFNESS_N_mm, 0.01, 0.005))
    assert servo.step(4.0).increment_mm == pytest.approx(0.0)
    servo.hold_at(4.5)
    # The next step goes all the way: half a newton on the known stiffness.
    assert servo.step(4.0).increment_mm == pytest.approx(0.5 / STIFFNESS_N_mm)
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="target_N"):
            servo.hold_at(wrong)


def test_a_set_point_nearer_to_the_limit_comes_with_a_lower_speed() -> None:
    servo = ForceServo(settings_from(4.0, STIFFNESS_N_mm, 0.01, 0.0045, largest_speed_mm_s=0.9))
    servo.hold_at(12.0, largest_speed_mm_s=0.3)
    assert servo.step(4.0).speed_mm_s <= 0.3
    servo.hold_at(4.0, largest_speed_mm_s=9.0)
    assert servo.settings.speed_mm_s == pytest.approx(200.0 / STIFFNESS_N_mm)
    with pytest.raises(ValueError, match="largest_speed_mm_s 0 must be above 0"):
        servo.hold_at(4.0, largest_speed_mm_s=0.0)


def test_the_noise_of_an_earlier_slide_is_not_replayed() -> None:
    """At 200 Hz the axis steps by a micrometre to and fro from tick to tick. The first value, to
    which the others refer, was such a step too: the slide began with a knock of 6 %."""
    expected = ContactShift()
    for tick in range(100):
        expected.add(0.005 * tick, 1e-3 * (0.5 + 0.5 * (-1) ** tick))
    servo = ForceServo(settings_from(4.0, stiffness_N_mm=145.0, tick_s=0.005, delay_s=0.0045))
    for _ in range(20):
        servo.step(4.0)
    servo.slide_begins(expected)
    moves_um = [1e3 * servo.step(4.0).increment_mm for _ in range(20)]
    assert max(abs(move) for move in moves_um) < 0.35

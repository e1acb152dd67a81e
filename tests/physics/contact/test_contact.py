"""Contact and friction: what must hold for any load, and what the reference case gives."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.physics.contact import kernel
from rig.physics.contact.settings import ContactSettings, Cylinder, FrictionSettings, Plate, Sphere
from rig.physics.contact.slices import SlicedStepper, hertz_radius
from rig.physics.contact.stepper import (
    OPEN,
    STICK,
    ContactStepper,
    ConvergenceError,
    concatenate,
)
from rig.physics.contact.truth import SlipWatch
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings


def friction(static: float, kinetic: float | None = None) -> ContactSettings:
    kinetic = static if kinetic is None else kinetic
    return ContactSettings(
        friction=FrictionSettings(static_coefficient=static, kinetic_coefficient=kinetic)
    )


def press(force_N: float, steps: int = 400) -> np.ndarray:
    return force_N * (1 - np.cos(np.pi * np.arange(1, steps + 1) / steps)) / 2


def ridges_touching(block) -> np.ndarray:
    return (block.ridge_normal_N > 0).sum(axis=1)


@pytest.fixture(scope="module")
def small(skin_cache) -> CondensedSkin:
    return build_skin(SkinSettings(ridges=3, elements_per_ridge=4), skin_cache)


def test_ridges_come_into_contact_as_in_the_paper(skin8: CondensedSkin):
    stepper = ContactStepper(skin8, ContactSettings(), Plate())
    block = stepper.advance(press(4.0, 3000), 0.0)
    seen = [
        int(ridges_touching(block)[np.argmax(block.normal_force_N >= force - 1e-9)])
        for force in (0.27, 1.0, 2.0, 3.0, 4.0)
    ]
    assert seen == [3, 5, 7, 7, 9]


def test_the_load_is_shared_as_in_the_reference_case(reference_slide):
    shared = reference_slide.block.ridge_normal_N[4499]
    reference = [0.024, 0.347, 0.568, 0.694, 0.736, 0.694, 0.568, 0.347, 0.024]
    assert shared == pytest.approx(reference, abs=0.005)


def test_a_symmetric_load_gives_a_symmetric_answer(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, ContactSettings(), Plate(), keep_forces=True)
    block = stepper.advance(press(4.0), 0.0)
    m = skin6.nodes
    p, t = block.forces_N[:, :m], block.forces_N[:, m:]
    assert np.abs(p - p[:, ::-1]).max() < 1e-9 * 4
    assert np.abs(t + t[:, ::-1]).max() < 1e-9 * 4


def test_opposite_slides_are_mirror_images(skin6: CondensedSkin):
    x = np.concatenate([np.zeros(400), 2e-4 * np.arange(1, 1501)])
    force = np.concatenate([press(4.0), np.full(1500, 4.0)])
    right = ContactStepper(skin6, ContactSettings(), Plate()).advance(force, x)
    left = ContactStepper(skin6, ContactSettings(), Plate()).advance(force, -x)
    scale = np.abs(right.ridge_tangential_N).max()
    assert np.abs(right.ridge_tangential_N + left.ridge_tangential_N[:, ::-1]).max() < 1e-6 * scale


@settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    static=st.floats(0.0, 1.3),
    weakening=st.floats(0.6, 1.0),
    distance_um=st.floats(0.5, 40.0),
    relaxation_ms=st.floats(0.0, 2.0),
    force_N=st.floats(0.05, 8.0),
    seed=st.integers(0, 2**32 - 1),
    roller=st.booleans(),
)
def test_any_motion_obeys_the_laws_of_contact(
    small, static, weakening, distance_um, relaxation_ms, force_N, seed, roller
):
    """Balance to 1e-9 F_n, no pull, Coulomb's limit, no created energy, for wild motions."""
    rng = np.random.default_rng(seed)
    contact = ContactSettings(
        friction=FrictionSettings(
            static_coefficient=static,
            kinetic_coefficient=static * weakening,
            weakening_distance_um=distance_um,
        ),
        relaxation_time_ms=relaxation_ms,
    )
    steps = 300
    force = force_N * np.clip(np.cumsum(rng.normal(0, 0.05, steps)) + 0.5, 0.0, 1.0)
    x = np.cumsum(rng.normal(0, 1, steps).cumsum() * 2e-5)
    body = Cylinder(radius_mm=20.0) if roller else Plate()
    stepper = ContactStepper(small, contact, body, keep_forces=True)
    block = stepper.advance(force, x)
    m = small.nodes
    p, t = block.forces_N[:, :m], block.forces_N[:, m:]
    assert np.abs(p.sum(axis=1) - force).max() <= 1e-9 * force_N
    assert p.min() >= -1e-10
    assert (np.abs(t) - static * p).max() <= 1e-9
    assert block.dissipated_mJ.min() >= -1e-12
    assert (p[block.status == OPEN] == 0).all()


@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    force_N=st.floats(0.2, 6.0),
    start_mm=st.floats(-1.5, 1.5),
    seed=st.integers(0, 2**32 - 1),
    roller=st.booleans(),
)
def test_any_mirrored_motion_gives_the_mirrored_answer(small, force_N, start_mm, seed, roller):
    rng = np.random.default_rng(seed)
    force = np.concatenate([press(force_N, 100), np.full(300, force_N)])
    x = np.concatenate([np.zeros(100), np.cumsum(np.cumsum(rng.normal(0, 2e-5, 300)))])
    body = Cylinder(radius_mm=20.0) if roller else Plate()
    turn = np.concatenate([np.zeros(100), rng.normal(0, 1e-5, 300)]) if roller else np.zeros(400)
    blocks = []
    for sign in (1.0, -1.0):
        stepper = ContactStepper(
            small, ContactSettings(), body, position_mm=sign * start_mm, watched_ridge=1
        )
        where = sign * (start_mm + x)
        blocks.append(stepper.advance(force, where, rotation_rad=sign * turn))
    there, mirrored = blocks
    assert mirrored.ridge_normal_N[:, ::-1] == pytest.approx(there.ridge_normal_N, abs=1e-6)
    assert -mirrored.ridge_tangential_N[:, ::-1] == pytest.approx(
        there.ridge_tangential_N, abs=1e-6
    )
    assert mirrored.stress_MPa[:, ::-1, 1] == pytest.approx(there.stress_MPa[:, :, 1], abs=1e-7)


def test_rubber_without_load_relaxes_with_its_time_constant(skin6: CondensedSkin):
    """Backward Euler: each step of Δt leaves 1/(1 + Δt/τ) of the displacement."""
    for relaxation_ms in (0.5, 2.0):
        contact = ContactSettings(relaxation_time_ms=relaxation_ms)
        stepper = ContactStepper(skin6, contact, Plate())
        stepper.advance(press(4.0), 0.0)
        before, _ = stepper.displacement_mm()
        stepper.advance(np.zeros(10), 0.0)
        after, _ = stepper.displacement_mm()
        left = (1 + 0.1 / relaxation_ms) ** -10
        assert after == pytest.approx(left * before, rel=1e-9, abs=1e-15)
    elastic = ContactSettings(relaxation_time_ms=0.0)
    stepper = ContactStepper(skin6, elastic, Plate())
    stepper.advance(press(4.0), 0.0)
    stepper.advance(0.0, 0.0)
    assert not np.any(stepper.displacement_mm())


def test_a_pressed_skin_creeps_to_its_elastic_depth(skin6: CondensedSkin):
    """A force put on at once: most of the depth is still missing after one step of τ/5."""
    depth = {}
    for relaxation_ms in (0.0, 0.5):
        contact = ContactSettings(relaxation_time_ms=relaxation_ms)
        block = ContactStepper(skin6, contact, Plate()).advance(np.full(300, 4.0), 0.0)
        depth[relaxation_ms] = block.approach_mm
    assert depth[0.5][0] < 0.5 * depth[0.0][0]
    assert depth[0.5][-1] == pytest.approx(depth[0.0][-1], rel=0.02)
    assert (np.diff(depth[0.5]) > -1e-9).all()


def test_a_skin_that_slid_heals_while_it_rests(skin6: CondensedSkin):
    """The breakaway force after a rest grows with the rest, from μ_k F_n towards the first one's.

    It may pass that one: the skin starts from another stress than when it was first pressed.
    """
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    stepper.advance(press(4.0), 0.0)
    first = stepper.advance(np.full(4000, 4.0), 2e-4 * np.arange(1, 4001))
    slid = stepper.state
    peaks = []
    for rest_steps in (0, 100, 200, 2000):
        stepper.state = slid
        if rest_steps:
            # back until nothing drags, so that the nodes stick
            stepper.advance(np.full(500, 4.0), 0.8 - 2e-4 * np.arange(1, 501))
            stepper.advance(np.full(rest_steps, 4.0), 0.7)
        again = stepper.advance(np.full(4000, 4.0), stepper.position_mm + 2e-4 * np.arange(1, 4001))
        peaks.append(again.tangential_force_N.max())
    assert peaks[0] == pytest.approx(0.65 * 4, rel=1e-6)
    assert peaks[0] < peaks[1] < peaks[2] < peaks[3]
    assert first.tangential_force_N.max() < peaks[3] < 0.8 * 4


def test_the_contact_area_is_that_of_the_nodes_that_touch(skin6: CondensedSkin):
    block = ContactStepper(skin6, ContactSettings(), Plate()).advance(press(4.0), 0.0)
    by_hand = (block.status != OPEN) @ skin6.tributary_mm() * skin6.settings.width_mm
    assert block.contact_area_mm2 == pytest.approx(by_hand)
    assert (np.diff(block.contact_area_mm2) >= 0).all()
    whole_tops = 9 * 1.4 * 20
    assert 0.3 * whole_tops < block.contact_area_mm2[-1] < whole_tops


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_the_truth_does_not_depend_on_the_blocks_it_came_in(data):
    steps = data.draw(st.integers(1, 40))
    seed = data.draw(st.integers(0, 2**32 - 1))
    cuts = sorted(data.draw(st.lists(st.integers(0, steps), max_size=5)))
    status = np.random.default_rng(seed).integers(0, 4, (steps, 6)).astype(np.int8)
    ridge = np.array([0, 0, 1, 1, 2, 2])
    whole, parts = SlipWatch(ridge, 1e-4, 5e-4), SlipWatch(ridge, 1e-4, 5e-4)
    whole.add(status)
    for part in np.split(status, cuts):
        parts.add(part)
    for name in ("first_slip_s", "whole_slip_s", "lift_off_s", "gross_slip_s"):
        a, b = getattr(whole.truth(), name), getattr(parts.truth(), name)
        assert a == pytest.approx(b, nan_ok=True), name


def test_without_friction_nothing_is_dragged(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, friction(0.0), Plate())
    block = stepper.advance(
        np.concatenate([press(4.0), np.full(500, 4.0)]),
        np.concatenate([np.zeros(400), 1e-3 * np.arange(500)]),
    )
    assert np.abs(block.ridge_tangential_N).max() < 1e-9
    assert block.dissipated_mJ.max() < 1e-12


def test_with_very_large_friction_the_contact_is_a_weld(skin6: CondensedSkin):
    """As long as no node closes or opens, F_t follows from the compliance alone."""
    welded = friction(1000.0).model_copy(update={"relaxation_time_ms": 0.0})
    stepper = ContactStepper(skin6, welded, Plate())
    pressed = stepper.advance(press(4.0), 0.0)
    block = stepper.advance(np.full(20, 4.0), 1e-6 * np.arange(1, 21))
    assert (block.status <= STICK).all()
    assert (block.status == pressed.status[-1]).all()
    m, touching = skin6.nodes, np.flatnonzero(pressed.status[-1] != OPEN)
    held = np.concatenate([touching, m + touching])
    n = touching.size
    moved = np.zeros((2 * n + 1, 2 * n + 1))
    moved[:-1, :-1] = skin6.compliance_mm_N[np.ix_(held, held)]
    moved[:n, -1], moved[-1, :n] = -1.0, 1.0
    right = np.concatenate([np.zeros(n), np.full(n, 20e-6), [0.0]])
    by_hand = np.linalg.solve(moved, right)[n : 2 * n].sum()
    gained = block.tangential_force_N[-1] - pressed.tangential_force_N[-1]
    assert gained == pytest.approx(by_hand, rel=1e-6)


def test_a_skin_dragged_in_full_slip_carries_mu_k_f_n(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    stepper.advance(press(4.0), 0.0)
    block = stepper.advance(np.full(4000, 4.0), 2e-4 * np.arange(1, 4001))
    assert block.tangential_force_N[-1] == pytest.approx(0.65 * 4.0, rel=1e-6)
    assert block.tangential_force_N.max() <= 0.8 * 4.0
    work = np.sum(block.tangential_force_N * np.diff(block.position_mm, prepend=0.0))
    assert block.dissipated_mJ.sum() < work


def test_lift_off_and_contact_again_leave_no_residue(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    x = np.concatenate([np.zeros(200), 2e-4 * np.arange(600), np.full(200, 0.12)])
    force = np.concatenate([press(4.0, 200), np.full(600, 4.0), press(4.0, 200)[::-1]])
    force[-1] = 0.0
    first = stepper.advance(force, x)
    rest = stepper.advance(np.zeros(500), np.zeros(500))
    assert (rest.status == OPEN).all()
    assert np.abs(rest.ridge_normal_N).max() == 0.0
    down, sideways = stepper.displacement_mm()
    assert max(np.abs(down).max(), np.abs(sideways).max()) < 1e-12
    second = stepper.advance(force, x)
    assert second.tangential_force_N == pytest.approx(first.tangential_force_N, abs=1e-8)
    assert np.array_equal(second.status, first.status)


def test_a_commanded_height_gives_back_the_force_that_made_it(skin6: CondensedSkin):
    x = np.concatenate([np.zeros(400), 2e-4 * np.arange(400)])
    force = np.concatenate([press(4.0), np.full(400, 4.0)])
    given_force = ContactStepper(skin6, ContactSettings(), Plate()).advance(force, x)
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    given_height = stepper.advance(given_force.approach_mm, x, normal_control="position")
    assert given_height.normal_force_N == pytest.approx(force, abs=1e-6)
    assert given_height.tangential_force_N == pytest.approx(
        given_force.tangential_force_N, abs=1e-5
    )


def test_a_plate_held_above_the_skin_touches_nothing(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    block = stepper.advance(np.linspace(-1.0, 0.05, 200), 0.0, normal_control="position")
    above = block.approach_mm < 0
    assert (block.normal_force_N[above] == 0).all()
    assert (block.normal_force_N[block.approach_mm > 0.01] > 0).all()


def test_a_weight_below_the_friction_limit_stays_and_above_it_runs_away(skin6: CondensedSkin):
    for ratio, slips in ((0.6, False), (1.1, True)):
        stepper = ContactStepper(skin6, ContactSettings(), Plate())
        stepper.advance(press(4.0), 0.0)
        pull = 0.8 * 4.0 * ratio * np.clip(np.arange(1, 4001) / 2000, 0, 1)
        block = stepper.advance(np.full(4000, 4.0), pull, tangential_control="force")
        watch = SlipWatch(skin6.ridge, stepper.step_s)
        watch.add(block.status[500:])
        assert np.isfinite(watch.truth().gross_slip_s) == slips
        if slips:
            assert block.position_mm[-1] > 5.0
        else:
            assert block.tangential_force_N[-1] == pytest.approx(pull[-1], rel=0.02)


def test_moving_everything_together_changes_nothing(skin_cache):
    settings_here = SkinSettings(ridges=3, elements_per_ridge=4)
    here = build_skin(settings_here, skin_cache)
    there = build_skin(settings_here.model_copy(update={"axis_x_mm": 3.7}), skin_cache)
    force = np.concatenate([press(1.0), np.full(300, 1.0)])
    x = np.concatenate([np.full(400, -0.4), -0.4 + 3e-4 * np.arange(300)])
    turn = np.full(700, 1e-5)
    blocks = [
        ContactStepper(skin, ContactSettings(), Cylinder(), position_mm=shift - 0.4).advance(
            force, x + shift, rotation_rad=turn
        )
        for skin, shift in ((here, 0.0), (there, 3.7))
    ]
    assert np.array_equal(blocks[0].status, blocks[1].status)
    assert blocks[1].ridge_tangential_N == pytest.approx(blocks[0].ridge_tangential_N, abs=1e-8)
    assert blocks[1].approach_mm == pytest.approx(blocks[0].approach_mm, abs=1e-10)


def test_a_plate_has_no_place_of_its_own(skin6: CondensedSkin):
    force = np.concatenate([press(4.0), np.full(800, 4.0)])
    x = np.concatenate([np.zeros(400), 2e-4 * np.arange(800)])
    here = ContactStepper(skin6, ContactSettings(), Plate()).advance(force, x)
    far = ContactStepper(skin6, ContactSettings(), Plate(), position_mm=64.0)
    there = far.advance(force, x + 64.0)
    assert there.tangential_force_N == pytest.approx(here.tangential_force_N, abs=1e-8)


def test_blocks_and_restored_states_give_the_same_bytes(skin6: CondensedSkin):
    force = np.concatenate([press(4.0), np.full(1200, 4.0)])
    x = np.concatenate([np.zeros(400), 2e-4 * np.arange(1200)])
    whole = ContactStepper(skin6, ContactSettings(), Plate()).advance(force, x)
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    edges = [0, 1, 2, 150, 401, 1100]
    parts = [stepper.advance(force[a:b], x[a:b]) for a, b in pairwise(edges)]
    kept = stepper.state
    parts.append(stepper.advance(force[1100:], x[1100:]))
    joined = concatenate(parts)
    assert np.array_equal(joined.stress_MPa, whole.stress_MPa)
    assert np.array_equal(joined.status, whole.status)
    fresh = ContactStepper(skin6, ContactSettings(), Plate())
    fresh.state = kept
    again = fresh.advance(force[1100:], x[1100:])
    assert np.array_equal(again.stress_MPa, whole.stress_MPa[1100:])


@settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**32 - 1), kinetic=st.floats(0.5, 1.0), rolls=st.booleans())
def test_what_is_not_looked_at_does_not_matter(
    small: CondensedSkin, seed: int, kinetic: float, rolls: bool
):
    """Steps whose open nodes are left alone do what steps do that look at everything."""
    rng = np.random.default_rng(seed)
    corners = np.array([-0.01, 0.05, *rng.uniform(0.0, 0.06, 4), -0.02])
    approach = np.interp(np.arange(900) / 150, np.arange(7), corners)
    x = np.interp(np.arange(900) / 150, np.arange(7), rng.uniform(-0.1, 0.1, 7))
    body = Cylinder(radius_mm=100.0) if rolls else Plate()
    turn = np.diff(x, prepend=x[0]) / 100.0 if rolls else np.zeros(900)
    contact = friction(0.8, 0.8 * kinetic)
    one = ContactStepper(small, contact, body, position_mm=x[0], watched_ridge=1)
    other = ContactStepper(small, contact, body, position_mm=x[0], watched_ridge=1)
    quick = one.advance(approach, x, rotation_rad=turn, normal_control="position")
    steps = []
    for k in range(900):
        state = other.state
        state.integers[kernel.AGAIN] = kernel.LOOKED_AT_EVERY
        other.state = state
        here = slice(k, k + 1)
        steps.append(
            other.advance(
                approach[here], x[here], rotation_rad=turn[here], normal_control="position"
            )
        )
    whole = concatenate(steps)
    assert whole.normal_force_N.max() > 0.5
    assert np.array_equal(quick.status, whole.status)
    assert np.abs(quick.normal_force_N - whole.normal_force_N).max() < 1e-8
    assert np.abs(quick.tangential_force_N - whole.tangential_force_N).max() < 1e-8
    assert np.abs(quick.stress_MPa - whole.stress_MPa).max() < 1e-9
    for mine, theirs in zip(one.displacement_mm(), other.displacement_mm(), strict=True):
        assert np.abs(mine - theirs).max() < 1e-9


def test_a_step_without_an_answer_is_raised_and_undone(skin6: CondensedSkin):
    """A node that closes while dragged jams at huge friction: Coulomb's law has no answer."""
    stepper = ContactStepper(skin6, friction(1000.0), Plate())
    stepper.advance(press(4.0), 0.0)
    before = stepper.state
    with pytest.raises(ConvergenceError, match="of 500 found no consistent set") as caught:
        stepper.advance(np.full(500, 4.0), 1e-3 * np.arange(1, 501))
    done = int(str(caught.value).split()[2]) - 1
    after = stepper.state
    stepper.state = before
    stepper.advance(np.full(done, 4.0), 1e-3 * np.arange(1, done + 1))
    before = stepper.state
    for name in ("force_N", "status", "downward_mm", "sideways_mm", "bonded", "scalars"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name


def test_a_broken_skin_is_raised_not_computed(skin6: CondensedSkin):
    broken = replace(skin6, compliance_mm_N=np.full_like(skin6.compliance_mm_N, np.nan))
    with pytest.raises(ConvergenceError):
        ContactStepper(broken, ContactSettings(), Plate()).advance(4.0, 0.0)


def test_inputs_out_of_range_are_refused(skin6: CondensedSkin):
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    with pytest.raises(ValueError, match="-1 N must be at least 0 N"):
        stepper.advance(-1.0, 0.0)
    with pytest.raises(ValueError, match="finite"):
        stepper.advance(np.nan, 0.0)
    with pytest.raises(ValueError, match="plate does not rotate"):
        stepper.advance(1.0, 0.0, rotation_rad=0.1)
    with pytest.raises(ValueError, match="watched_ridge 9 must lie between 0 and 8"):
        ContactStepper(skin6, ContactSettings(), Plate(), watched_ridge=9)


def test_pure_rolling_hardly_drags_the_skin(skin6: CondensedSkin):
    """A cylinder whose axis travels R times its angle does not slide on it."""
    radius = 30.0
    turn = np.full(1000, np.deg2rad(1.0) / 1000)
    x = -1.0 + radius * np.cumsum(turn)
    rolled = ContactStepper(skin6, ContactSettings(), Cylinder(), position_mm=-1.0)
    rolled.advance(press(2.0), -1.0)
    pure = rolled.advance(np.full(1000, 2.0), x, rotation_rad=turn)
    slid = ContactStepper(skin6, ContactSettings(), Cylinder(), position_mm=-1.0)
    slid.advance(press(2.0), -1.0)
    dragged = slid.advance(np.full(1000, 2.0), x)
    assert np.abs(pure.tangential_force_N).max() < 0.05 * dragged.tangential_force_N.max()


def test_slices_carry_the_load_of_a_sphere(skin6: CondensedSkin):
    body = Sphere(radius_mm=30.0)
    stepper = SlicedStepper(skin6, ContactSettings(), body, largest_force_N=4.0)
    block = stepper.advance(press(4.0), 0.0)
    assert block.normal_force_N == pytest.approx(press(4.0), rel=1e-9, abs=1e-12)
    assert 2 * stepper.slice_mm * body.slices == pytest.approx(6.9, abs=0.05)
    shares = stepper.shares(4.0)[0]
    assert (np.diff(shares) < 0).all()
    assert shares.sum() == pytest.approx(0.5)
    assert hertz_radius(skin6.settings, 30.0, 4.0) == pytest.approx(3.44, abs=0.01)


def test_a_sphere_presses_ridge_3_less_than_a_cylinder_of_the_same_load(skin6: CondensedSkin):
    """On a third of the width the same load sinks in deeper and spreads over more ridges."""
    stepper = SlicedStepper(skin6, ContactSettings(), Sphere(radius_mm=30.0), position_mm=-4.0)
    sphere = stepper.advance(press(4.0), -4.0)
    roller = ContactStepper(skin6, ContactSettings(), Cylinder(radius_mm=30.0), position_mm=-4.0)
    cylinder = roller.advance(press(4.0), -4.0)
    read, compared = (-b.stress_MPa[-1, :, 1].mean() for b in (sphere, cylinder))
    assert 0.5 * compared < read < compared
    assert sphere.ridge_normal_N[-1, 2] < cylinder.ridge_normal_N[-1, 2]
    assert ridges_touching(sphere)[-1] >= ridges_touching(cylinder)[-1]


def test_slices_are_undone_together(skin6: CondensedSkin):
    """A slice that finds no answer takes the others back with it."""
    stepper = SlicedStepper(skin6, friction(1000.0), Sphere(radius_mm=30.0, slices=3))
    stepper.advance(press(4.0), 0.0)
    before = stepper.state
    with pytest.raises(ConvergenceError):
        stepper.advance(np.full(3000, 4.0), 1e-3 * np.arange(1, 3001))
    for was, now in zip(before, stepper.state, strict=True):
        assert np.array_equal(was.force_N, now.force_N)
        assert np.array_equal(was.scalars, now.scalars)


def test_what_a_sphere_cannot_do_is_refused_by_name(skin6: CondensedSkin):
    stepper = SlicedStepper(skin6, ContactSettings(), Sphere(radius_mm=30.0))
    with pytest.raises(ValueError, match="sphere takes a commanded position only"):
        stepper.advance(4.0, 0.1, tangential_control="force")
    with pytest.raises(ValueError, match="at most 8 N"):
        stepper.advance(9.0, 0.0)
    with pytest.raises(ValueError, match="sphere radius_mm 900"):
        SlicedStepper(skin6, ContactSettings(), Sphere(radius_mm=900.0))


def test_friction_that_cannot_be_corrected_has_a_new_inverse_not_a_rescue(skin_cache):
    """Close to the coefficient at which the contact jams, a coefficient that has moved by less than
    FRICTION_REFRESH is too far for the correction, even if the inverse was new a step before."""
    skin = build_skin(SkinSettings(ridges=5, elements_per_ridge=4), skin_cache)
    law = FrictionSettings(
        static_coefficient=1.36443, kinetic_coefficient=0.409329, weakening_distance_um=88.23
    )
    settings = ContactSettings(friction=law, relaxation_time_ms=2.0, step_us=50.0)
    stepper = ContactStepper(skin, settings, Plate())
    n = 2.95822 * np.minimum(1, np.arange(1, 67) / 30)
    x = np.maximum(0, np.arange(-29, 37)) * 200 * 50e-6
    stepper.advance(n[:64], x[:64])
    state = stepper.state
    state.integers[kernel.VALID] = 0
    stepper.state = state
    stepper.advance(n[64], x[64])
    state = stepper.state
    assert state.integers[kernel.UPDATES] == 0
    slips = state.held_status > STICK
    state.friction[slips] = np.abs(state.slopes[slips]) + 0.0499
    stepper.state = state
    stepper.advance(n[65], x[65])
    assert stepper.state.integers[kernel.REBUILDS] > state.integers[kernel.REBUILDS]
    assert stepper.state.integers[kernel.RESCUES] == state.integers[kernel.RESCUES]

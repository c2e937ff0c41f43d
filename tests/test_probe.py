"""Probing for a contact that was not where it was planned: a guarded move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.execution.probe import (
    FOLLOWED,
    PROBE_SPEED,
    REACH,
    guarded_move,
    nodes_below,
)
from clamber.model.kinematics import Kinematics
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import World, build_world
from clamber.planning.trajectory import RATE, holding_torque
from clamber.step.ik import IK
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.stability import statics_at
from oracles import contact_drift

STEPS = range(6)


def made_at(plan, step):
    """The contact that a step makes, those that bear meanwhile, and the touch."""
    after = plan.keyframes[step + 1].stance
    before = {c.surface for c in plan.keyframes[step].stance}
    made = next(c for c in after if c.surface not in before)
    held = tuple(c for c in after if c is not made)
    return made, held, plan.changes[step].touching


def depths(world: World, t, contact, normal, every: int = 20) -> np.ndarray:
    """(n, 2) how far the surface is below its contact, and to the side [m]."""
    kin, out = Kinematics(world), []
    for q in t.q[::every]:
        kin.update(q)
        off = kin.contact_point(contact.surface, normal) - contact.position
        up = float(off @ normal)
        out.append((-up, np.linalg.norm(off - up * normal)))
    return np.array(out)


# Probing for a contact.


@pytest.mark.parametrize("step", STEPS)
def test_probing_goes_straight_down_the_normal_and_ends_within_reach(demo_plan, step):
    made, held, q = made_at(demo_plan, step)
    t = guarded_move(demo_plan.world, held, made, q)
    down, side = depths(demo_plan.world, t, made, np.array([0.0, 0.0, 1.0])).T
    assert abs(down[0]) < 1e-3
    assert np.all(np.diff(down) > -1e-4)
    assert down[-1] == pytest.approx(REACH, abs=FOLLOWED)
    assert down.max() < REACH + 1e-3
    # The last posture of a swing may lie beside the contact, which has rolled.
    assert np.abs(side - side[0]).max() < 2e-3


def test_a_limb_that_was_set_off_its_place_feels_under_itself(demo_plan):
    """It does not wander to where it was planned: it would slip off what it touches."""
    made, held, q = made_at(demo_plan, STEPS[-1])
    for aside in (-0.05, 0.05):
        other = replace(made, position=made.position + np.array([0.0, aside, 0.0]))
        t = guarded_move(demo_plan.world, held, other, q)
        down, side = depths(demo_plan.world, t, made, np.array([0.0, 0.0, 1.0])).T
        assert down[-1] > 0.5 * REACH
        assert np.abs(side - side[0]).max() < 2e-3


@pytest.mark.parametrize("step", STEPS)
def test_probing_keeps_held_contacts_and_balance(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t, kin = guarded_move(world, held, made, q), Kinematics(world)
    for x in t.q[::40]:
        kin.update(x)
        assert max(contact_drift(kin, c) for c in held) < 5e-4
        polygon = support_polygon(statics_at(kin, x, held)[0].points[:, :2])
        assert com_margin(kin.com[:2], polygon) > 0.005
        # Between postures at a limit the spline may pass it by a fifth of a degree.
        assert np.all(x[world.qadr] >= world.q_min[world.dadr] - 3.5e-3)
        assert np.all(x[world.qadr] <= world.q_max[world.dadr] + 3.5e-3)


@pytest.mark.parametrize("step", STEPS)
def test_probing_is_slow_and_begins_and_ends_at_rest(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t = guarded_move(world, held, made, q)
    down = depths(world, t, made, np.array([0.0, 0.0, 1.0]))[:, 0]
    assert np.abs(np.diff(down)).max() * RATE / 20 < 1.2 * PROBE_SPEED
    assert np.median(np.diff(down)) * RATE / 20 > 0.4 * PROBE_SPEED
    assert np.allclose(t.q[0], q, atol=1e-5)
    assert np.abs(t.v[0]).max() < 1e-4
    assert np.abs(t.v[-1]).max() < 1e-4
    assert np.array_equal(t.time, np.arange(len(t.time)) / RATE)
    # Nothing is held before or after: it is probed for at once.
    assert np.abs(t.v[100]).max() > 1e-3
    assert np.abs(t.v[-100]).max() > 2e-4


@pytest.mark.parametrize("step", STEPS)
def test_meanwhile_only_what_is_held_is_closed_and_bears(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t = guarded_move(world, held, made, q)
    closed = {s for s, c in zip(t.surfaces, t.contact.T, strict=True) if c.any()}
    assert closed == {c.surface for c in held}
    assert t.contact[:, [t.surfaces.index(c.surface) for c in held]].all()
    tau = holding_torque(Kinematics(world), t.q[0], held)
    assert np.allclose(t.tau[0], tau, atol=0.02 * np.abs(tau).max())


def test_on_a_slope_it_goes_along_that_normal(demo_plan):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, 0)
    box = replace(world.scene.boxes[0], rotation=matrix_from_rpy((0.0, -0.25, 0.0)))
    tilted = build_world(world.robot, replace(world.scene, boxes=(box,)))
    n = tilted.supports["box"].normal
    kin = Kinematics(tilted)
    kin.update(q)
    contact = replace(made, position=kin.contact_point(made.surface, n))
    t = guarded_move(tilted, held, contact, q)
    down, side = depths(tilted, t, contact, n).T
    assert n[0] == pytest.approx(-np.sin(0.25))
    assert down[-1] > 0.05
    assert side.max() < 0.01


def test_the_box_that_is_believed_there_is_no_obstacle_to_probing(demo_plan):
    """The surface goes deep into where the top was planned."""
    made, held, q = made_at(demo_plan, 0)
    t, kin = guarded_move(demo_plan.world, held, made, q), Kinematics(demo_plan.world)
    kin.update(t.q[-1])
    top = demo_plan.world.supports["box"]
    p = kin.contact_point(made.surface, top.normal)
    assert top.inside(p)
    assert top.height(p) < -0.1


def test_what_cannot_be_reached_is_not_probed_for(demo_plan):
    world = demo_plan.world
    made, held, _ = made_at(demo_plan, 0)
    down = replace(made, position=made.position - [0.0, 0.0, 1.5])
    assert guarded_move(world, held, down, world.home) is None


def test_probing_leaves_the_world_and_its_start_as_they_were(demo_plan):
    made, held, q = made_at(demo_plan, 2)
    before, top = q.copy(), demo_plan.world.supports["box"].position.copy()
    a = guarded_move(demo_plan.world, held, made, q)
    b = guarded_move(demo_plan.world, held, made, q)
    assert np.array_equal(q, before)
    assert np.array_equal(demo_plan.world.supports["box"].position, top)
    assert np.array_equal(a.q, b.q)
    assert np.array_equal(a.tau, b.tau)


@pytest.mark.parametrize("step", STEPS)
def test_where_one_margin_does_not_reach_the_next_goes_on(demo_plan, step):
    made, held, q = made_at(demo_plan, step)
    ik = IK(demo_plan.world)
    free = np.zeros(len(demo_plan.world.pairs), dtype=bool)

    def below(*margins):
        return nodes_below(ik, held, made, q, free, margins)[1]

    assert below(0.5) == [0.0]  # no stance has that margin
    assert below(0.5, 0.01) == below(0.01)
    assert below(0.01)[-1] > 0.0
    assert below(0.045, 0.01)[-1] >= below(0.01)[-1]

"""What is sensed, against the state that it is sensed of."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from clamber.execution.sensors import (
    ANGLE_NOISE,
    BLOCK,
    FORCE_NOISE,
    FORCE_SCALE_NOISE,
    FORCE_STRIDE,
    POSITION_NOISE,
    ROTATION_NOISE,
    Sensors,
    contact_forces,
)
from clamber.model.scene import Scene
from clamber.model.world import World, build_world

N = 4 * BLOCK


@pytest.fixture(scope="module")
def world(coman) -> World:
    return build_world(coman, Scene.from_height(0.275))


def sensors(world, noise=0.0, delay=0.0, seed=1) -> Sensors:
    rng = np.random.default_rng([seed, 1])
    return Sensors(world, noise=noise, delay=delay, rng=rng)


def standing(world: World, steps: int = 600) -> mujoco.MjData:
    """On its feet, its servos at home."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.home
    for j, name in enumerate(world.joints):
        data.ctrl[world.model.actuator(name).id] = world.home[world.qadr[j]]
    for _ in range(steps):
        mujoco.mj_step(world.model, data)
    return data


@pytest.fixture(scope="module")
def stood(world) -> mujoco.MjData:
    return standing(world)


def rows_of(world: World) -> np.ndarray:
    """(ngeom,) which surface a geom belongs to, by its name; -2: of the scene."""
    out = np.where(world.model.geom_bodyid == 0, -2, -1)
    for g in range(world.model.ngeom):
        name = world.model.geom(g).name
        for i, s in enumerate(world.surfaces):
            if name == s or name.startswith(s + "_"):
                out[g] = i
    return out


def summed_by_mujoco(world: World, data: mujoco.MjData) -> np.ndarray:
    """(surfaces, 3) forces of the environment, contact by contact."""
    row, out = rows_of(world), np.zeros((len(world.surfaces), 3))
    fixed = world.model.geom_bodyid == 0
    for i, c in enumerate(data.contact):
        if fixed[c.geom1] == fixed[c.geom2]:
            continue
        force = np.zeros(6)
        mujoco.mj_contactForce(world.model, data, i, force)
        on_second = c.frame.reshape(3, 3).T @ force[:3]
        geom, sign = (c.geom1, -1.0) if fixed[c.geom2] else (c.geom2, 1.0)
        if row[geom] >= 0:
            out[row[geom]] += sign * on_second
    return out


def surface_forces(world: World, data: mujoco.MjData) -> np.ndarray:
    """(surfaces, 3) as they are sensed."""
    forces = contact_forces(world)
    forces.update(data)
    return forces.surface


def read_many(world, data, n=N, **kw):
    s = sensors(world, **kw)
    readings = [s.read(data) for _ in range(n)]
    return np.array([r.q for r in readings]), np.array([r.force for r in readings])


def moving(world: World, n: int):
    """States of a robot that sinks into its knees: (time, data) step by step."""
    data = standing(world, 50)
    for name in ("LKneeSag", "RKneeSag", "LElbj"):
        data.ctrl[world.model.actuator(name).id] -= 0.2
    for k in range(n):
        mujoco.mj_step(world.model, data)
        yield k, data


# The truth.


def test_without_noise_and_delay_it_is_the_truth(world):
    s, force = sensors(world), None
    for k, data in moving(world, 60):
        reading = s.read(data)
        assert np.array_equal(reading.q, data.qpos)
        if k % FORCE_STRIDE == 0:
            force = surface_forces(world, data)
        assert np.array_equal(reading.force, force)


def test_forces_are_renewed_every_few_steps_only(world):
    s, forces = sensors(world, noise=1.0), []
    for _, data in moving(world, 4 * FORCE_STRIDE):
        forces.append(s.read(data).force)
    blocks = np.array(forces).reshape(4, FORCE_STRIDE, -1)
    assert np.all(blocks == blocks[:, :1])
    assert np.all(np.abs(np.diff(blocks[:, 0], axis=0)).max(axis=1) > 0)


# Delay.


@pytest.mark.parametrize("late", [1, 2, 7, 20])
def test_a_delay_gives_the_reading_of_so_many_steps_ago(world, late):
    now, then = sensors(world), sensors(world, delay=late * 1e-3)
    fresh, old = [], []
    for _, data in moving(world, 60):
        fresh.append(now.read(data))
        old.append(then.read(data))
    for k, reading in enumerate(old):
        expected = fresh[max(k - late, 0)]
        assert np.array_equal(reading.q, expected.q)
        assert np.array_equal(reading.force, expected.force)


# Noise.


def test_encoders_have_the_stated_noise_each_its_own(world, stood):
    q, _ = read_many(world, stood, noise=1.0)
    e = (q - stood.qpos)[:, world.qadr]
    n, joints = e.shape
    assert np.allclose(e.mean(axis=0), 0.0, atol=5 * ANGLE_NOISE / np.sqrt(n))
    assert e.std() == pytest.approx(ANGLE_NOISE, rel=0.02)
    assert np.allclose(e.std(axis=0), ANGLE_NOISE, rtol=5 / np.sqrt(2 * n))
    mixed = np.corrcoef(e.T) - np.eye(joints)
    assert np.abs(mixed).max() < 5 / np.sqrt(n)


def test_the_base_has_the_stated_noise_and_stays_a_pose(world, stood):
    q, _ = read_many(world, stood, noise=1.0)
    e = q[:, :3] - stood.qpos[:3]
    assert np.allclose(e.std(axis=0), POSITION_NOISE, rtol=0.08)
    assert np.allclose(e.mean(axis=0), 0.0, atol=5 * POSITION_NOISE / np.sqrt(len(e)))
    assert np.allclose(np.linalg.norm(q[:, 3:7], axis=1), 1.0, atol=1e-12)
    turn = np.zeros((len(q), 3))
    for out, quat in zip(turn, q[:, 3:7], strict=True):
        mujoco.mju_subQuat(out, quat, stood.qpos[3:7])
    assert np.allclose(turn.std(axis=0), ROTATION_NOISE, rtol=0.08)
    assert np.allclose(
        turn.mean(axis=0), 0.0, atol=5 * ROTATION_NOISE / np.sqrt(len(turn))
    )


def test_forces_have_noise_that_grows_with_the_force(world, stood):
    truth = surface_forces(world, stood)
    _, force = read_many(world, stood, 8 * N, noise=1.0)
    e = (force - truth)[::FORCE_STRIDE]
    expected = np.hypot(FORCE_NOISE, FORCE_SCALE_NOISE * np.abs(truth))
    assert truth[:, 2].max() > 100.0  # so that the second part counts
    assert np.allclose(e.std(axis=0), expected, rtol=5 / np.sqrt(2 * len(e)))
    assert np.all(np.abs(e.mean(axis=0)) < 5 * expected / np.sqrt(len(e)))


def test_noise_is_white_also_from_one_block_to_the_next(world, stood):
    q, force = read_many(world, stood, noise=1.0)
    for e in (q[:, 7:] - stood.qpos[7:], q[:, :3] - stood.qpos[:3]):
        n = len(e)
        for lag in (1, 2, BLOCK // 2, BLOCK):
            share = np.mean(e[lag:] * e[:-lag], axis=0) / e.var(axis=0)
            assert np.abs(share).max() < 5 / np.sqrt(n - lag)
    e = force[::FORCE_STRIDE, :, 0].ravel()
    assert len(np.unique(e)) == e.size  # no draw is used twice


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_the_factor_multiplies_all_noise(world, stood, factor):
    q, force = read_many(world, stood, 60, noise=1.0)
    q2, force2 = read_many(world, stood, 60, noise=factor)
    truth = surface_forces(world, stood)
    far = [*range(3), *world.qadr]
    assert np.allclose((q2 - stood.qpos)[:, far], factor * (q - stood.qpos)[:, far])
    assert np.allclose(force2 - truth, factor * (force - truth))
    a, b = np.zeros(3), np.zeros(3)
    for one, other in zip(q, q2, strict=True):
        mujoco.mju_subQuat(a, one[3:7], stood.qpos[3:7])
        mujoco.mju_subQuat(b, other[3:7], stood.qpos[3:7])
        assert np.allclose(b, factor * a, atol=1e-12)


def test_the_same_seed_has_the_same_noise_and_another_other(world, stood):
    a, b, c = (
        read_many(world, stood, BLOCK + 50, noise=1.0, seed=s) for s in (1, 1, 2)
    )
    assert np.array_equal(a[0], b[0])
    assert np.array_equal(a[1], b[1])
    assert not np.any(a[0][:, world.qadr] == c[0][:, world.qadr])
    assert not np.any(a[1] == c[1])


# Forces.


def test_standing_still_the_feet_bear_the_weight(world, stood):
    force = surface_forces(world, stood)
    weight = 9.81 * world.mass
    total = force.sum(axis=0)
    assert total[2] == pytest.approx(weight, rel=2e-3)
    assert np.abs(total[:2]).max() < 0.01 * weight
    by_name = dict(zip(world.surfaces, force, strict=True))
    assert by_name["LFoot"][2] == pytest.approx(by_name["RFoot"][2], rel=0.02)
    assert not any(f.any() for s, f in by_name.items() if not s.endswith("Foot"))


@pytest.mark.parametrize("seed", range(4))
def test_forces_are_those_that_mujoco_sums_contact_by_contact(demo_plan, seed):
    """Pressed against ground and box at once, moving, so that friction acts too."""
    world, rng = demo_plan.world, np.random.default_rng(seed)
    data, pressed = mujoco.MjData(world.model), 0
    for key in demo_plan.keyframes[1:]:
        data.qpos[:] = key.q
        data.qpos[2] -= 0.002
        data.qvel[:] = rng.normal(0.0, 0.2, world.model.nv)
        mujoco.mj_forward(world.model, data)
        force = surface_forces(world, data)
        expected = summed_by_mujoco(world, data)
        assert np.allclose(force, expected, atol=1e-9)
        pressed += np.count_nonzero(np.linalg.norm(expected, axis=1) > 1.0)
        assert np.abs(expected[:, :2]).max() > 1.0
    assert pressed >= 3 * len(demo_plan.keyframes[1:])


def test_a_link_that_is_no_surface_is_not_felt(world):
    """Lying on its back: the ground bears it, surfaces have little to do with it."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.home
    data.qpos[:3] = [-2.0, 0.0, 0.25]
    mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array([0.0, 1.0, 0.0]), -np.pi / 2)
    for _ in range(400):
        mujoco.mj_step(world.model, data)
    expected = summed_by_mujoco(world, data)
    force = surface_forces(world, data)
    assert np.allclose(force, expected, atol=1e-9)
    assert data.ncon > 0
    assert force[:, 2].sum() < 0.7 * 9.81 * world.mass

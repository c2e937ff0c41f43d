"""The world that physics runs, against geometry by hand and MuJoCo's own figures."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.execution.perturbed import (
    PUSH_MARGIN,
    PUSH_TIME,
    perturbed_scene,
    perturbed_world,
    push_of,
)
from clamber.execution.simulation import simulate
from clamber.model.boxes import grid_triangles
from clamber.model.patches import mesh_of
from clamber.model.scene import Box, Mesh, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import PHYSICS_STEP, World, build_world

YAW = 0.4
EXACT = {"noise": 0.0, "delay": 0.0}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A box as it is mostly met, and one that lies askew."""
    return Scene(
        boxes=(
            Box(
                name="box",
                size=np.array([1.0, 1.2, 0.3]),
                centre=np.array([0.8, 0.0, 0.15]),
                rotation=np.eye(3),
                friction=0.7,
            ),
            Box(
                name="step",
                size=np.array([0.6, 0.45, 0.5]),
                centre=np.array([2.0, 0.5, 0.25]),
                rotation=matrix_from_rpy((0.0, 0.0, YAW)),
                friction=0.6,
            ),
        ),
        ground_friction=0.9,
        start=np.array([0.1, -0.2, 0.05]),
    )


@pytest.fixture(scope="module")
def world(coman, scene) -> World:
    return build_world(coman, scene)


@pytest.fixture(scope="module")
def uneven(world) -> World:
    return perturbed_world(world, Disturbance(unevenness=0.04))


def corner(box: Box, x: float, y: float, z: float) -> np.ndarray:
    """(3,) a point of a box in the world, its coordinates in half lengths."""
    return box.centre + box.rotation @ (0.5 * box.size * [x, y, z])


def geom_corner(world: World, name: str, x: float, y: float, z: float) -> np.ndarray:
    """The same of the compiled geom."""
    g = world.model.geom(name)
    R = Rotation.from_quat(g.quat, scalar_first=True).as_matrix()
    return g.pos + R @ (g.size * [x, y, z])


def height_by_ray(world: World, p: np.ndarray) -> tuple[float, str]:
    """What a ray that falls past `p` (x, y) meets first: its height, its name."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.home
    data.qpos[:3] = [-5.0, 0.0, 1.0]  # out of the way
    mujoco.mj_kinematics(world.model, data)
    geom = np.zeros(1, dtype=np.int32)
    above = np.array([p[0], p[1], 3.0])
    down = np.array([0.0, 0.0, -1.0])
    fall = mujoco.mj_ray(world.model, data, above, down, None, 1, -1, geom, None)
    return 3.0 - fall, world.model.geom(int(geom[0])).name


def tiles_of(world: World, box: str) -> dict[tuple[int, int], str]:
    names = [world.model.geom(g).name for g in range(world.model.ngeom)]
    out = {}
    for name in names:
        if name.startswith(f"{box}_tile_"):
            i, j = name.removeprefix(f"{box}_tile_").split("_")
            out[int(i), int(j)] = name
    return out


def tops_of(world: World, box: Box) -> np.ndarray:
    """(nx, ny) heights of the tiles over the top of the plain box, along its normal."""
    tiles = tiles_of(world, box.name)
    n = np.max(list(tiles), axis=0) + 1
    out = np.full(n, np.nan)
    for (i, j), name in tiles.items():
        middle = geom_corner(world, name, 0, 0, 1)
        out[i, j] = (middle - box.top.position) @ box.top.normal
    return out


# Nothing, and another scene.


def test_without_a_difference_it_is_the_world_itself(world):
    assert perturbed_world(world, Disturbance()) is world
    run_only = Disturbance(delay=0.01, noise=3.0, push=50.0, seed=4)
    assert perturbed_world(world, run_only) is world


def test_another_true_scene_is_built_and_disturbed_in_its_turn(world, coman):
    truth = Scene.from_height(0.2)
    plain = perturbed_world(world, Disturbance(), truth)
    assert plain.xml == build_world(coman, truth).xml
    higher = perturbed_world(world, Disturbance(height=0.05), truth)
    assert higher.supports["box"].position[2] == pytest.approx(0.25)


# Heights and tilts.


@pytest.mark.parametrize("height", [0.05, -0.05])
def test_boxes_are_higher_and_stay_on_the_ground(world, scene, height):
    there, rise = perturbed_world(world, Disturbance(height=height)), [0, 0, height]
    for b in scene.boxes:
        for x in (-1, 1):
            for y in (-1, 1):
                low, high = (geom_corner(there, b.name, x, y, z) for z in (-1, 1))
                assert np.allclose(low, corner(b, x, y, -1), atol=1e-6)
                assert np.allclose(high - corner(b, x, y, 1), rise, atol=1e-6)
        top = there.supports[b.name]
        assert np.allclose(top.position - b.top.position, rise, atol=1e-12)


@pytest.mark.parametrize("turn", [(np.pi / 2, 0, 0), (0, np.pi / 2, 0), (np.pi, 0, 0)])
def test_a_box_on_its_side_is_disturbed_as_it_lies(scene, turn):
    """The same body, described by axes that lie otherwise: the same top."""
    upright = scene.boxes[0]
    R = matrix_from_rpy(turn)
    lying = replace(
        upright,
        size=np.abs(R.T @ upright.size),
        rotation=upright.rotation @ R,
    )
    d = Disturbance(height=0.04)

    def corners(box: Box) -> np.ndarray:
        higher = perturbed_scene(replace(scene, boxes=(box,)), d).boxes[0]
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        points = higher.centre + 0.5 * signs * higher.size @ higher.rotation.T
        return points[np.lexsort(points.round(6).T)]

    assert np.allclose(corners(lying), corners(upright), atol=1e-9)


@pytest.mark.parametrize("pitch", [0.2, -0.2])
def test_a_pitch_sinks_the_far_end_and_leaves_the_near_edge(world, scene, pitch):
    there = perturbed_world(world, Disturbance(pitch=pitch))
    for b in scene.boxes:
        length = b.size[0]
        for y in (-1, 1):
            near, far = (geom_corner(there, b.name, x, y, 1) for x in (-1, 1))
            assert np.allclose(near, corner(b, -1, y, 1), atol=1e-6)
            sunk = far - corner(b, 1, y, 1)
            assert sunk[2] == pytest.approx(-length * np.sin(pitch), abs=1e-5)
            assert np.linalg.norm(far - near) == pytest.approx(length, abs=1e-5)
            # It stays abreast: nothing moves along the edge.
            assert sunk @ b.rotation[:, 1] == pytest.approx(0.0, abs=1e-5)


def test_a_roll_turns_about_the_middle_of_the_near_edge(world, scene):
    roll = 0.15
    there = perturbed_world(world, Disturbance(roll=roll))
    for b in scene.boxes:
        middle = geom_corner(there, b.name, -1, 0, 1)
        assert np.allclose(middle, corner(b, -1, 0, 1), atol=1e-6)
        left, right = (geom_corner(there, b.name, -1, y, 1) for y in (1, -1))
        rise = 0.5 * b.size[1] * np.sin(roll)
        assert left[2] - middle[2] == pytest.approx(rise, abs=1e-5)
        assert right[2] - middle[2] == pytest.approx(-rise, abs=1e-5)


def test_the_robot_starts_off_by_what_is_said(world, scene):
    d = Disturbance(x=0.03, y=-0.02, yaw=0.1)
    there = perturbed_world(world, d)
    assert np.allclose(there.scene.start - scene.start, [0.03, -0.02, 0.1])
    ankles = []
    for w in (world, there):
        data = mujoco.MjData(w.model)
        data.qpos[:] = w.home
        mujoco.mj_kinematics(w.model, data)
        ends = [w.robot.limbs[n].end for n in ("left_leg", "right_leg")]
        points = [w.landmark(n) for n in ends]
        ankles.append(
            [data.xpos[b] + data.xmat[b].reshape(3, 3) @ p for b, p in points]
        )
    (l0, r0), (l1, r1) = ankles
    off = 0.5 * (l1 + r1) - 0.5 * (l0 + r0)
    assert np.allclose(off, [0.03, -0.02, 0.0], atol=1e-9)
    a, b = (l0 - r0)[:2], (l1 - r1)[:2]
    turned = np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
    assert turned == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize("height", [-0.2901, -0.5])
def test_a_box_that_would_vanish_is_the_users_mistake(world, height):
    with pytest.raises(InputError, match=r"disturb\.height is .*\(box is 0\.3 m high"):
        perturbed_world(world, Disturbance(height=height))
    perturbed_scene(world.scene, Disturbance(height=-0.28))  # as low as it may be


# Friction, mass, effort.


def test_friction_is_what_mujocos_contacts_have(world):
    """A foot on the ground, and one on the box: the supports' friction counts."""
    for friction in (None, 0.3):
        there = perturbed_world(world, Disturbance(friction=friction, x=0.5))
        expected = {"ground": friction or 0.9, "box": friction or 0.7}
        for support, mu in expected.items():
            data = mujoco.MjData(there.model)
            data.qpos[:] = there.home
            if support == "box":
                data.qpos[:3] += [0.2, 0.2, 0.299]
            else:
                data.qpos[:3] += [-1.0, 0.0, -0.001]
            mujoco.mj_forward(there.model, data)
            g = there.support_geom[support]
            seen = [c.friction[0] for c in data.contact if g in (c.geom1, c.geom2)]
            assert len(seen) >= 8
            assert np.allclose(seen, mu)
            assert there.supports[support].friction == pytest.approx(mu)


def test_the_mass_matrix_is_multiplied_up_to_the_rotors(world):
    """An independent look: M = factor * M_links + armature."""
    there = perturbed_world(world, Disturbance(mass=1.3))
    M = []
    for w in (world, there):
        data, full = mujoco.MjData(w.model), np.zeros((w.model.nv, w.model.nv))
        data.qpos[:] = w.home
        mujoco.mj_forward(w.model, data)
        for i, column in enumerate(full):
            mujoco.mj_mulM(w.model, data, column, np.eye(w.model.nv)[i])
        M.append(full)
        assert np.array_equal(w.model.dof_armature, world.model.dof_armature)
    rotors = np.diag(world.model.dof_armature)
    assert np.allclose(M[1] - rotors, 1.3 * (M[0] - rotors), rtol=1e-4, atol=1e-5)


def test_effort_limits_are_multiplied_and_saturate(world):
    there = perturbed_world(world, Disturbance(effort=0.4))
    assert np.allclose(there.tau_max, 0.4 * world.tau_max, rtol=1e-6)
    data = mujoco.MjData(there.model)
    data.qpos[:] = there.home
    data.ctrl[:] = 1e3
    mujoco.mj_forward(there.model, data)
    order = [there.model.actuator(j).id for j in there.joints]
    assert np.allclose(data.actuator_force[order], there.tau_max)


def test_one_disturbance_changes_nothing_else(world):
    a = world.model
    b = perturbed_world(world, Disturbance(mass=1.3)).model
    assert np.array_equal(a.geom_pos, b.geom_pos)
    assert np.array_equal(a.actuator_forcerange, b.actuator_forcerange)
    c = perturbed_world(world, Disturbance(effort=0.4)).model
    assert np.array_equal(a.body_mass, c.body_mass)
    assert np.array_equal(a.geom_friction, c.geom_friction)
    for m in (b, c):
        assert (m.nq, m.nv, m.ngeom) == (a.nq, a.nv, a.ngeom)
        assert m.opt.timestep == PHYSICS_STEP


# Tiles.


def test_the_highest_or_lowest_tile_is_off_by_exactly_what_is_said(uneven, scene):
    for b in scene.boxes:
        off = tops_of(uneven, b)
        assert not np.isnan(off).any()
        assert np.abs(off).max() == pytest.approx(0.04, abs=2e-6)
        assert off.std() > 0.004  # and the others differ


def test_a_ray_that_falls_on_the_top_never_passes_between_tiles(uneven, scene, rng):
    """Every point of the top lies on a tile, seams within a hundredth of a mm too."""
    for b in scene.boxes:
        off = tops_of(uneven, b)
        n = np.array(off.shape)
        side = b.size[:2] / n
        at = rng.uniform(-0.499, 0.499, (60, 2)) * b.size[:2]
        seams = (rng.integers(1, n, (60, 2)) - n / 2) * side
        seams += rng.choice([-1e-5, 1e-5], (60, 2))
        at = np.vstack([at, seams])
        for x, y in at:
            p = corner(b, 2 * x / b.size[0], 2 * y / b.size[1], 1)
            z, name = height_by_ray(uneven, p)
            i, j = np.floor([x, y] / side + n / 2).astype(int)
            assert name == f"{b.name}_tile_{i}_{j}"
            assert z == pytest.approx(b.size[2] + off[i, j], abs=1e-5)


def test_tiles_stand_in_the_box_that_carries_them(uneven, scene):
    """Their lower faces meet the sunken box's top: nothing falls in from the side."""
    for b in scene.boxes:
        lid = geom_corner(uneven, b.name, 0, 0, 1)
        assert np.allclose(
            geom_corner(uneven, b.name, 1, 1, -1), corner(b, 1, 1, -1), atol=1e-5
        )
        for name in tiles_of(uneven, b.name).values():
            under = geom_corner(uneven, name, 0, 0, -1)
            assert (under - lid) @ b.top.normal == pytest.approx(0.0, abs=1e-5)
            assert np.allclose(
                uneven.model.geom(name).quat, uneven.model.geom(b.name).quat
            )


def test_tiles_bear_like_their_box(uneven, scene):
    m = uneven.model
    for b in scene.boxes:
        box = m.geom(b.name)
        for name in tiles_of(uneven, b.name).values():
            tile = m.geom(name)
            assert np.array_equal(tile.friction, box.friction)
            assert np.array_equal(tile.solref, box.solref)
            assert tile.priority == box.priority
            assert tile.condim == box.condim
            assert uneven.support_of_geom[tile.id] == b.name


def test_neighbouring_tiles_are_alike(uneven, scene):
    """Warped, not gravel: neighbours differ less than tiles far apart."""
    off = tops_of(uneven, scene.boxes[0])
    near = np.abs(np.diff(off, axis=0)).mean()
    far = np.abs(off[:-5] - off[5:]).mean()
    assert near < 0.6 * far


def test_tiles_follow_a_tilted_box(world, scene):
    d = Disturbance(unevenness=0.03, pitch=0.2, height=0.05)
    there = perturbed_world(world, d)
    for b in perturbed_scene(scene, d).boxes:
        off = tops_of(there, b)
        assert np.abs(off).max() == pytest.approx(0.03, abs=2e-6)


def test_a_low_box_keeps_its_tiles_above_ground(world, coman):
    low = build_world(coman, Scene.from_height(0.05))
    there = perturbed_world(low, Disturbance(unevenness=0.15))
    for name in tiles_of(there, "box").values():
        assert there.model.geom(name).size[2] >= 0.001 - 1e-9


def test_the_same_seed_has_the_same_tiles_and_another_seed_others(world, uneven, scene):
    again = perturbed_world(world, Disturbance(unevenness=0.04))
    assert again.xml == uneven.xml
    assert np.array_equal(again.model.geom_pos, uneven.model.geom_pos)
    other = perturbed_world(world, Disturbance(unevenness=0.04, seed=1))
    for b in scene.boxes:
        assert np.abs(tops_of(other, b) - tops_of(uneven, b)).max() > 0.01
    twice = perturbed_world(world, Disturbance(unevenness=0.02))
    for b in scene.boxes:
        assert np.allclose(tops_of(twice, b), 0.5 * tops_of(uneven, b), atol=3e-6)


def test_the_two_boxes_are_warped_differently(uneven, scene):
    a, b = (tops_of(uneven, box) for box in scene.boxes)
    n = np.minimum(a.shape, b.shape)
    assert np.abs(a[: n[0], : n[1]] - b[: n[0], : n[1]]).max() > 0.01


# The written file is the world.


@pytest.mark.parametrize(
    "d",
    [
        Disturbance(height=0.02, pitch=0.1),
        Disturbance(unevenness=0.03, mass=1.2, effort=0.9, friction=0.5),
    ],
    ids=["scene", "tiles"],
)
def test_whoever_loads_the_written_world_has_the_same_model(world, d):
    there = perturbed_world(world, d)
    loaded = mujoco.MjModel.from_xml_string(there.xml)
    for name in (
        *("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref"),
        *("body_mass", "body_inertia", "body_ipos", "body_iquat"),
        *("actuator_forcerange", "actuator_gainprm", "dof_damping", "dof_armature"),
    ):
        assert np.array_equal(getattr(loaded, name), getattr(there.model, name)), name


def test_plain_mujoco_repeats_a_disturbed_and_pushed_run(demo_plan):
    """Written world, commands and push are all there is to a run."""
    t = demo_plan.trajectory
    cut = {n: getattr(t, n)[:1500] for n in ("time", "q", "v", "tau", "contact")}
    short = replace(demo_plan, trajectory=replace(t, **cut))
    d = Disturbance(unevenness=0.02, mass=1.1, friction=0.6, push=20.0)
    rollout = simulate(short, controller="pid", disturbance=d)
    model = mujoco.MjModel.from_xml_string(rollout.world.xml)
    base = model.body(demo_plan.world.robot.base).id
    data = mujoco.MjData(model)
    data.qpos[:] = rollout.qpos[0]
    assert rollout.push.shape == (len(rollout.ctrl), 3)
    assert np.count_nonzero(rollout.push.any(axis=1)) == 200
    for k, (ctrl, push) in enumerate(zip(rollout.ctrl, rollout.push, strict=True)):
        if k % rollout.stride == 0:
            i = k // rollout.stride  # recorded in single precision
            assert np.array_equal(np.float32(data.qpos), rollout.qpos[i])
            assert np.array_equal(np.float32(data.qvel), rollout.qvel[i])
        data.ctrl[:] = ctrl
        data.xfrc_applied[base, :3] = push
        mujoco.mj_step(model, data)


# The push.


@pytest.mark.parametrize("seed", range(20))
def test_a_push_is_short_horizontal_of_its_magnitude_and_within_the_run(seed):
    duration = 7.0
    push = push_of(Disturbance(push=60.0, seed=seed), duration)
    on = push.any(axis=1)
    first, last = np.flatnonzero(on)[[0, -1]]
    assert on[first : last + 1].all()
    assert last == len(push) - 1
    assert (last + 1 - first) * PHYSICS_STEP == pytest.approx(PUSH_TIME)
    assert np.allclose(np.linalg.norm(push[on], axis=1), 60.0)
    assert np.all(push[on] == push[first])
    assert not push[:, 2].any()
    assert first * PHYSICS_STEP >= PUSH_MARGIN - PHYSICS_STEP
    assert (last + 1) * PHYSICS_STEP <= duration - PUSH_MARGIN + PHYSICS_STEP


def test_over_seeds_pushes_come_at_all_times_and_from_all_sides():
    starts, angles = [], []
    for seed in range(200):
        push = push_of(Disturbance(push=1.0, seed=seed), 10.0)
        starts.append(np.flatnonzero(push.any(axis=1))[0] * PHYSICS_STEP)
        angles.append(np.arctan2(push[-1, 1], push[-1, 0]))
    inside = 10.0 - PUSH_TIME - 2 * PUSH_MARGIN
    assert np.mean(starts) == pytest.approx(5.0 - 0.5 * PUSH_TIME, abs=0.2 * inside / 2)
    assert np.ptp(starts) > 0.9 * inside
    assert abs(np.mean(np.exp(1j * np.array(angles)))) < 0.2


def test_the_same_seed_pushes_the_same_and_the_force_only_scales_it():
    a = push_of(Disturbance(push=10.0, seed=3), 8.0)
    assert np.array_equal(a, push_of(Disturbance(push=10.0, seed=3), 8.0))
    assert np.allclose(3.0 * a, push_of(Disturbance(push=30.0, seed=3), 8.0))
    b = push_of(Disturbance(push=10.0, seed=4), 8.0)
    assert len(a) != len(b) or not np.allclose(a, b)


def test_a_run_too_short_for_the_margins_is_pushed_at_its_earliest():
    push = push_of(Disturbance(push=10.0), 0.8)
    assert np.flatnonzero(push.any(axis=1))[0] * PHYSICS_STEP == PUSH_MARGIN


# Scans.


def scanned(noise: float, rng) -> Mesh:
    """A block of 0.2 m on the ground as it is seen from above, with noise."""
    x, y = np.arange(0.21, 0.91, 0.02), np.arange(-0.3, 0.31, 0.02)
    inside = (x > 0.24) & (x < 0.88) & (np.abs(y[:, None]) < 0.28)
    vertices, faces = grid_triangles(x, y, np.where(inside, 0.2, 0.0))
    vertices = vertices + rng.uniform(-noise, noise, size=vertices.shape)
    return mesh_of("scan", vertices, faces, friction=0.7)


def test_physics_meets_a_scan_as_it_was_measured_and_keeps_where_the_robot_stands(
    coman, rng
):
    mesh = scanned(0.005, rng)
    planned = build_world(coman, Scene(meshes=(mesh,), start=np.zeros(3)))
    truth = perturbed_world(planned, Disturbance())
    assert np.array_equal(truth.home, planned.home)
    (field,) = np.flatnonzero(truth.model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
    assert np.all(truth.model.geom_friction[field] == [0.7, 0.02, 0.001])
    assert truth.support_of_geom[field] == mesh.supports[0].name
    data = mujoco.MjData(truth.model)
    mujoco.mj_forward(truth.model, data)
    assert mesh.field is not None
    heights, down = mesh.field.heights, np.array([0.0, 0.0, -1.0])
    rows, columns = heights.shape
    left, right = (mesh.field.position + s * mesh.field.size / 2 for s in (-1, 1))
    for i, j in rng.integers(3, (rows - 3, columns - 3), size=(50, 2)):
        xy = left + (right - left) * [j / (columns - 1), i / (rows - 1)]
        found = mujoco.mj_ray(
            truth.model,
            data,
            np.array([*xy, 1.0]),
            down,
            None,
            1,
            int(truth.base),
            np.zeros(1, np.int32),
        )
        assert 1.0 - found == pytest.approx(max(heights[i, j], 0.0), abs=1e-4)


def test_a_scan_is_raised_with_its_field(coman, rng):
    planned = Scene(meshes=(scanned(0.005, rng),), start=np.zeros(3))
    raised = perturbed_scene(planned, Disturbance(height=0.03)).meshes[0]
    before = planned.meshes[0].field
    assert before is not None
    assert raised.field is not None
    np.testing.assert_allclose(raised.field.heights, before.heights + 0.03)


def test_without_noise_physics_has_the_pieces_that_were_planned_with(coman, rng):
    mesh = scanned(0.0, rng)
    assert mesh.field is None
    planned = build_world(coman, Scene(meshes=(mesh,), start=np.zeros(3)))
    assert perturbed_world(planned, Disturbance()) is planned

"""The core's kinematics against MuJoCo's, on every robot there is."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from clamber.model.core import core_of
from clamber.model.kinematics import Kinematics
from clamber.model.propose import propose_robot, robot_yaml
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import World, build_world, recompiled
from humanoids import mjcf, urdf

FLAT = Scene(start=np.array([0.3, -0.2, 0.7]))


def with_loose_parts(spec: mujoco.MjSpec) -> None:
    """A part that slides and one on a ball joint, as loads and tools may hang."""
    at = spec.body("Waist")
    kinds = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_BALL
    for name, kind in zip(("slides", "swings"), kinds, strict=True):
        at = at.add_body(name=name, pos=[0.02, 0.1, 0.03], quat=[0.8, 0.6, 0.0, 0.0])
        joint = at.add_joint(type=kind, name=name)
        joint.pos, joint.axis = [0.01, -0.02, 0.03], [0.6, 0.0, 0.8]
        at.mass, at.inertia, at.explicitinertial = 0.4, [0.01] * 3, True
        at.ipos = [0.05, 0.0, 0.02]


@pytest.fixture(scope="module", params=["coman", "coman29", "mjcf", "urdf", "loose"])
def world(request, tmp_path_factory) -> World:
    if request.param in ("mjcf", "urdf"):
        folder = tmp_path_factory.mktemp("robot")
        model = folder / f"humanoid.{'xml' if request.param == 'mjcf' else 'urdf'}"
        model.write_text(mjcf() if request.param == "mjcf" else urdf())
        proposal = propose_robot(model)
        (folder / "robot.xml").write_text(proposal.mjcf)
        (folder / "robot.yaml").write_text(robot_yaml(proposal))
        return build_world(load_robot(folder / "robot.yaml"), FLAT)
    name = "coman" if request.param == "loose" else request.param
    plain = build_world(load_robot(name), FLAT)
    return plain if request.param != "loose" else recompiled(plain, with_loose_parts)


def anywhere(world: World, seed: int) -> np.ndarray:
    """(nq,) far from home, the base turned in any way and not quite of unit length."""
    rng = np.random.default_rng(seed)
    q = mujoco.MjData(world.model).qpos + rng.normal(size=world.model.nq)
    for j in range(world.model.njnt):
        kind, a = world.model.jnt_type[j], int(world.model.jnt_qposadr[j])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            q[a + 3 : a + 7] /= 1.01 * np.linalg.norm(q[a + 3 : a + 7])
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            q[a : a + 4] /= np.linalg.norm(q[a : a + 4])
    return q


@pytest.mark.parametrize("seed", range(5))
def test_bodies_are_where_mujoco_has_them_and_move_as_it_says(world, seed):
    m, q = world.model, anywhere(world, seed)
    kin = Kinematics(world)
    kin.update(q)
    rng = np.random.default_rng(seed)
    for body in rng.choice(np.arange(1, m.nbody), 6):
        p = kin.data.xpos[body] + rng.uniform(-0.2, 0.2, 3)
        x, R, com, jacobian = kin.core.kinematics(q, int(body), p)
        np.testing.assert_allclose(x, kin.data.xpos, atol=1e-12)
        np.testing.assert_allclose(R, kin.data.xmat.reshape(-1, 3, 3), atol=1e-12)
        np.testing.assert_allclose(com, kin.com_jacobian(), atol=1e-12)
        expected = np.concatenate(kin.jacobians(int(body), p))
        np.testing.assert_allclose(jacobian, expected, atol=1e-12)


def test_the_centre_of_mass_is_mujocos(world):
    q = np.array([anywhere(world, seed) for seed in range(5)])
    kin, expected = Kinematics(world), []
    for x in q:
        kin.update(x)
        expected.append(kin.com.copy())
    np.testing.assert_allclose(kin.core.centres_of_mass(q), expected, atol=1e-12)
    assert len(kin.core.centres_of_mass(q[:0])) == 0


def test_a_model_is_handed_over_once_for_each_world(world):
    assert core_of(world) is core_of(world)

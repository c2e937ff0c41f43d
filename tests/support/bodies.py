"""Small made-up bodies and robot motions, as files of other tools have them."""

from __future__ import annotations

import numpy as np

from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world

# Parents of SMPL's 24 joints, and where they are at rest: y up, arms spread [m].
PARENTS = [
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21,
]  # fmt: skip
REST = np.array([
    [0, 0, 0], [0.07, -0.08, 0], [-0.07, -0.08, 0], [0, 0.11, 0],
    [0.1, -0.47, 0], [-0.1, -0.47, 0], [0, 0.24, 0], [0.09, -0.87, -0.03],
    [-0.09, -0.87, -0.03], [0, 0.3, 0], [0.11, -0.93, 0.09], [-0.11, -0.93, 0.09],
    [0, 0.51, 0], [0.08, 0.42, 0], [-0.08, 0.42, 0], [0, 0.6, 0.05],
    [0.2, 0.45, 0], [-0.2, 0.45, 0], [0.46, 0.44, 0], [-0.46, 0.44, 0],
    [0.71, 0.45, 0], [-0.71, 0.45, 0], [0.79, 0.44, 0], [-0.79, 0.44, 0],
])  # fmt: skip


def body_model(joints: int = 24) -> dict[str, np.ndarray]:
    """A body model of two vertices a joint, and two shapes: taller, and wider.

    Joint j is the middle of its vertices, `rest + beta_0 * 0.1 rest + beta_1 ...`.
    """
    rest = REST[:joints]
    apart = np.array([0.01, 0.02, 0.03])
    v = np.concatenate([rest - apart, rest + apart])
    both = np.concatenate([rest, rest])
    wide = np.concatenate([rest * [1, 0, 0], rest * [1, 0, 0]])
    regressor = np.concatenate([np.eye(joints), np.eye(joints)], axis=1) / 2
    parents = np.array([[0, *PARENTS[1:joints]], range(joints)], dtype=np.uint32)
    parents[0, 0] = 2**32 - 1
    return {
        "v_template": v,
        "shapedirs": 0.1 * np.stack([both, wide], axis=2),
        "J_regressor": regressor,
        "kintree_table": parents,
    }


def body_motion(joints: int = 24, samples: int = 60) -> dict[str, np.ndarray]:
    """AMASS's words: a body that stands, z up, and bends its left knee slowly."""
    poses = np.zeros((samples, joints, 3))
    poses[:, 0, 0] = np.pi / 2  # y up becomes z up
    poses[:, 4, 0] = np.linspace(0.0, 0.8, samples)
    trans = np.tile([0.5, 0.1, 1.01], (samples, 1))
    return {
        "poses": poses.reshape(samples, -1),
        "trans": trans,
        "betas": np.array([0.5, -0.5]),
        "mocap_framerate": np.array(30.0),
        "gender": np.array("neutral"),
    }


def robot_motion(name: str = "coman", samples: int = 40) -> dict[str, object]:
    """GMR's words: a robot that stands, its quaternions x y z w."""
    world = build_world(load_robot(name), Scene(start=np.array([0.3, 0.2, 1.0])))
    q = np.tile(world.home, (samples, 1))
    return {
        "fps": 30,
        "root_pos": q[:, :3],
        "root_rot": q[:, [4, 5, 6, 3]],
        "dof_pos": q[:, world.qadr],
        "local_body_pos": None,
        "link_body_list": None,
    }

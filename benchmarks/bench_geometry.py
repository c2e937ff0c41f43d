"""Time of a distance by pair of kinds, and of a query of a robot, beside MuJoCo's.

    python benchmarks/bench_geometry.py

Shapes are about as large as they are apart, a quarter of the pairs overlapping; a
robot's posture moves by little, or by much, between queries within 0.1 m.
"""

from __future__ import annotations

import itertools
import time

import mujoco
import numpy as np

from clamber.model.core import SHAPES, near_pairs
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world

EACH = 60  # shapes of each kind
NAMES = [k.name.removeprefix("mjGEOM_").lower() for k in SHAPES]
REACH = 0.1  # [m]


def shapes(rng: np.random.Generator) -> mujoco.MjModel:
    """Geoms of each kind, in order."""
    spec = mujoco.MjSpec()
    for kind in range(7):
        for k in range(EACH):
            quat = rng.normal(size=4)
            g = spec.worldbody.add_geom(
                type=SHAPES[kind],
                size=rng.uniform(0.03, 0.2, 3),
                pos=rng.normal(0.0, 0.25, 3),
                quat=quat / np.linalg.norm(quat),
            )
            if kind == 6:
                corners = rng.normal(0.0, 0.1, (60, 3))
                spec.add_mesh(name=f"m{k}", uservert=corners.ravel())
                g.meshname = f"m{k}"
    return spec.compile()


def best(job, repeats: int = 5) -> float:
    """The shortest time of a call [us]."""
    took = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        took.append(time.perf_counter() - start)
    return 1e6 * min(took)


def by_kinds(rng: np.random.Generator) -> None:
    m = shapes(rng)
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    of_kind = [np.flatnonzero(m.geom_type == k) for k in SHAPES]
    print(f"{'us of a distance':22}{'clamber':>9}{'MuJoCo':>9}")
    for a, b in itertools.combinations_with_replacement(range(7), 2):
        if b == 0:
            continue
        every = itertools.product(of_kind[a].tolist(), of_kind[b].tolist())
        pairs = np.array([p for p in every if p[0] != p[1]])
        near = near_pairs(m, pairs)
        ours = best(lambda near=near: near.query(d.geom_xpos, d.geom_xmat, np.inf))
        few, fromto = pairs[:: max(1, len(pairs) // 500)].tolist(), np.zeros(6)

        def theirs(few=few, fromto=fromto) -> None:
            for i, j in few:
                mujoco.mj_geomDistance(m, d, i, j, 10.0, fromto)

        name = f"{NAMES[a]}, {NAMES[b]}"
        per = ours / len(pairs), best(theirs, 3) / len(few)
        print(f"{name:22}{per[0]:9.3f}{per[1]:9.2f}")


def by_robot(name: str, rng: np.random.Generator) -> None:
    world = build_world(load_robot(name), Scene.from_height(0.3))
    kin, fresh = Kinematics(world), Kinematics(world)
    d, nv = kin.data, world.model.nv
    print(f"{name}, {len(world.pairs)} pairs, median us of a query within {REACH} m")
    for size, what in ((0.0, "as before"), (1e-3, "a mm"), (0.03, "3 cm")):
        took, found, q = [], [], world.home.copy()
        for _ in range(400):
            v = size * rng.normal(size=nv)
            q = kin.integrate(q, v + 0.05 * kin.difference(q, world.home))
            kin.update(q)
            start = time.perf_counter()
            near = kin._near.query(d.geom_xpos, d.geom_xmat, REACH)
            took.append(time.perf_counter() - start)
            found.append(len(near[0]))
        median, n = 1e6 * float(np.median(took)), float(np.mean(found))
        print(f"  moved by {what:12}{median:8.1f}   {n:.0f} near")
    fresh.update(world.home)
    everything = best(lambda: fresh.proximity(np.inf))
    print(f"  all distances        {everything:8.1f}")


def main() -> None:
    rng = np.random.default_rng(0)
    by_kinds(rng)
    for name in ("coman", "coman29"):
        by_robot(name, rng)


if __name__ == "__main__":
    main()

"""Time of one balance test of a stance, here and in Klampt, on the same stances.

    python benchmarks/bench_statics.py

Both are given points, normals, friction and centre of mass afresh each time, build
pyramids with the same edges inside the friction cones, and answer whether forces within
them balance gravity. Also times the other functions of `clamber.step.statics`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clamber.step.polygon import (
    com_margin,
    polygon_halfplanes,
    support_ellipse,
    support_polygon,
)
from clamber.step.statics import (
    ContactPoints,
    Load,
    TorqueLimits,
    contact_forces,
    is_statically_stable,
    static_equilibrium,
)

STANCES = 1000
MASS = 30.0  # [kg]


def random_stance(rng: np.random.Generator) -> tuple[ContactPoints, np.ndarray]:
    """2 to 8 points, tilted normals, mu from 0.2 to 1, a centre of mass near."""
    nc = int(rng.integers(2, 9))
    points = rng.uniform(-0.4, 0.4, (nc, 3)) * [1.0, 1.0, 0.5]
    normals = np.c_[rng.normal(0.0, 0.35, (nc, 2)), np.ones(nc)]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    com = np.append(points[:, :2].mean(axis=0) + rng.normal(0.0, 0.08, 2), 0.5)
    mu, names = rng.uniform(0.2, 1.0, nc), [""] * nc
    return ContactPoints(points=points, normals=normals, mu=mu, names=names), com


def random_torque(rng: np.random.Generator, contacts: ContactPoints) -> TorqueLimits:
    """Of a humanoid with 29 joints, a few of them weak."""
    rows = 3 * len(contacts.points)
    return TorqueLimits(
        jacobian=rng.normal(0.0, 0.3, (rows, 35)),
        gravity=rng.normal(0.0, 10.0, 35),
        dofs=np.arange(6, 35, dtype=np.intc),
        limits=rng.uniform(20.0, 150.0, 29),
        names=[str(j) for j in range(29)],
    )


def timed(job: Callable, inputs: Sequence) -> tuple[float, list]:
    """Median time of a call [us], and all the results."""
    took, results = [], []
    for x in inputs:
        start = time.perf_counter()
        result = job(x)
        took.append(time.perf_counter() - start)
        results.append(result)
    return 1e6 * float(np.median(took)), results


def main() -> None:
    rng = np.random.default_rng(0)
    stances = [random_stance(rng) for _ in range(STANCES)]
    print(f"{STANCES} stances of 2 to 8 points; median time of a call")
    for edges in (4, 8):
        ours, verdicts = timed(
            lambda s: is_statically_stable(*s),
            [(replace(c, cone_edges=edges), com) for c, com in stances],
        )
        print(f"balance test, {edges} edges: clamber {ours:8.1f} us", end="")
        try:
            from klampt import robotsim
        except ImportError:
            print("   (pip install klampt compares)")
            continue
        robotsim.set_friction_cone_approximation_edges(edges)
        inputs = [(np.c_[c.points, c.normals, c.mu], tuple(com)) for c, com in stances]
        theirs, answers = timed(
            lambda s: robotsim.com_equilibrium(s[0], (0, 0, -1), s[1]), inputs
        )
        same = sum(a == (b is not None) for a, b in zip(verdicts, answers, strict=True))
        print(f"   Klampt {theirs:8.1f} us   {same} of {STANCES} agree")

    loads = [(c, Load(com=com, mass=MASS)) for c, com in stances]
    us, _ = timed(lambda s: contact_forces(*s), loads)
    print(f"contact_forces:            {us:8.1f} us")
    us, _ = timed(lambda s: static_equilibrium(*s), loads[:100])
    print(f"static_equilibrium:        {us:8.1f} us")
    jointed = [(*s, random_torque(rng, s[0])) for s in loads]
    for job in (contact_forces, static_equilibrium):
        us, _ = timed(lambda s, job=job: job(*s[:2], torque=s[2]), jointed)
        print(f"{job.__name__ + ', torques:':27}{us:8.1f} us")
    clouds = [rng.uniform(-0.4, 0.4, (16, 2)) for _ in range(STANCES)]
    us, polygons = timed(support_polygon, clouds)
    print(f"support_polygon, 16 points: {us:7.1f} us")
    for job in (polygon_halfplanes, support_ellipse):
        us, _ = timed(job, polygons)
        print(f"{job.__name__ + ':':27}{us:8.1f} us")
    us, _ = timed(lambda v: com_margin((0.0, 0.0), v), polygons)
    print(f"com_margin:                {us:8.1f} us")


if __name__ == "__main__":
    main()

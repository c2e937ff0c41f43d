"""Kinematic tree -> limbs: which chains are arms and legs, and how they bend.

A humanoid is told by its symmetry. Limbs are chains that come in pairs, one on either
side of the sagittal plane; the pair that reaches lowest are the legs, the heaviest of
the others the arms. Within a limb, the knee or elbow is the hinge with long levers on
either side. Which way it faces is told by several signs (`clamber.model.facing`).

The description stands upright at its zero posture, z up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.errors import InputError
from clamber.model.facing import bending_as_people_do, signs_of_ahead
from clamber.model.records import short_repr
from clamber.model.tree import Chain, Tree, joint_range

MIRRORED = 0.05  # share of the height: limbs this near to each other's mirror image
LEAST_JOINTS = 3  # of a limb
ONE_POINT = 0.01  # share of the height: legs that begin so near to each other
# A joint as far ahead of the ankle, of the shank, and as low, of the ankle: of toes.
TOE, TOE_HEIGHT = 0.15, 0.75
NAMED = 8  # joints, at most, in a message
SWEEP = 9  # samples of a joint's range
DENSEST = 3000.0  # [kg/m^3] of mass over collision geometry: links are no ghosts


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Anatomy:
    """Limbs by name, and which way the robot faces.

    Attributes:
        base: Body that floats.
        limbs: By `left_arm` and so on.
        trunk: Ids of the hinges between the base and the limbs.
        locked: Ids of the joints that are in no limb and carry none.
        forward: (3,) unit vector in the world at the zero posture, horizontal.
        signs: What told so, by name: how much it counts, negative against it.
    """

    base: int
    limbs: Mapping[str, Chain]
    trunk: tuple[int, ...]
    locked: tuple[int, ...]
    forward: np.ndarray
    signs: Mapping[str, float]

    __repr__ = short_repr

    def pair(self, kind: str) -> list[Chain]:
        """Left and right `arm` or `leg`."""
        return [self.limbs[f"{side}_{kind}"] for side in ("left", "right")]

    @property
    def moving(self) -> list[int]:
        """Ids of the joints of limbs and trunk, in the order of the model."""
        return sorted(
            [*self.trunk, *(j for c in self.limbs.values() for j in c.joints)]
        )


def find_limbs(tree: Tree) -> Anatomy:
    """Find the limbs.

    Raises:
        InputError: It has not two arms and two legs, or a limb has other than hinges.
    """
    model, data = tree.model, tree.data
    pairs = _paired(tree)
    if len(pairs) < 2:
        raise InputError(
            "two legs and two arms, mirror images of each other at the zero posture, z"
            f" up, of {LEAST_JOINTS} joints or more ({_found(tree, pairs)})",
            tree.source,
            "kinematic tree",
        )
    low = [min(data.xpos[tree.way_out(b)[-1], 2] for b in p) for p in pairs]
    legs = pairs[int(np.argmin(low))]
    rest = [p for p in pairs if p is not legs]
    arms = max(rest, key=lambda p: float(model.body_subtreemass[list(p)].sum()))
    chains = {
        name: [_chain(tree, b, name) for b in pair]
        for name, pair in (("arm", arms), ("leg", legs))
    }
    left = data.xpos[legs[0]] - data.xpos[legs[1]]
    if np.linalg.norm(left[:2]) < ONE_POINT * np.ptp(data.xipos[1:, 2]):
        left = data.subtree_com[legs[0]] - data.subtree_com[legs[1]]
    forward = np.cross([left[0], left[1], 0.0], [0.0, 0.0, 1.0])
    forward /= np.linalg.norm(forward)
    across = np.cross([0.0, 0.0, 1.0], forward)
    for pair in chains.values():
        pair.sort(key=lambda c: -float(data.xpos[c.end] @ across))
    signs = signs_of_ahead(tree, chains, forward)
    if sum(signs.values()) < 0 or (sum(signs.values()) == 0 and forward[0] < -1e-9):
        forward, signs = -forward, {n: -x for n, x in signs.items()}
        chains = {n: c[::-1] for n, c in chains.items()}
    limbs = {}
    for name, pair in chains.items():
        way = forward if name == "arm" else -forward
        folding = bending_as_people_do(tree, pair, way)
        for side, c in zip(("left", "right"), folding, strict=True):
            limbs[f"{side}_{name}"] = c
    used = {j for c in limbs.values() for j in c.joints} | {tree.root}
    carrying = set()
    for chain in limbs.values():
        b = int(model.jnt_bodyid[chain.joints[0]])
        while b:
            b = int(model.body_parentid[b])
            carrying |= set(tree.joints(b))
    carrying -= used
    for j in carrying:
        tree.must_be_hinge(j)
    return Anatomy(
        base=tree.base,
        limbs={n: limbs[n] for n in sorted(limbs)},
        trunk=tuple(sorted(carrying)),
        locked=tuple(sorted(set(range(model.njnt)) - used - carrying)),
        forward=forward,
        signs=signs,
    )


def _found(tree: Tree, pairs: list[tuple[int, int]]) -> str:
    """A sentence with the limbs found, and the joints left over."""
    model = tree.model
    limbs = [b for p in pairs for b in p]
    rest = [
        tree.name(j)
        for j in range(model.njnt)
        if j != tree.root
        and not any(tree.hangs_on(int(model.jnt_bodyid[j]), b) for b in limbs)
    ]
    names = [f"{model.body(a).name} and {model.body(b).name}" for a, b in pairs]
    return (
        f"found {', '.join(names) or 'none'}; other joints that move: "
        + (", ".join(rest[:NAMED]) or "none")
        + (f" and {len(rest) - NAMED} more" if len(rest) > NAMED else "")
    )


def _paired(tree: Tree) -> list[tuple[int, int]]:
    """First bodies of limbs that are mirror images, the legs' pair among them.

    Walks outwards from the base: where a body's children have mirror images among one
    another, they are limbs; the others are part of the trunk and are walked on.
    """
    pairs, trunk = [], [tree.base]
    while trunk:
        children = tree.children(trunk.pop())
        taken = set()
        for i, a in enumerate(children):
            for b in children[i + 1 :]:
                if a in taken or b in taken or not _alike(tree, a, b):
                    continue
                taken |= {a, b}
                joints = [tree.model.body_jntnum[tree.way_out(c)].sum() for c in (a, b)]
                if min(joints) >= LEAST_JOINTS:
                    pairs.append((a, b))
        trunk += [c for c in children if c not in taken]
    return pairs


def _alike(tree: Tree, a: int, b: int) -> bool:
    """Same joints, mass and height, and not in the same place."""
    if tree.count(a) != tree.count(b):
        return False
    mass = tree.model.body_subtreemass[[a, b]]
    if abs(mass[0] - mass[1]) > 0.1 * mass.max():
        return False
    near = MIRRORED * (float(np.ptp(tree.data.xipos[1:, 2])) or 1.0)
    p, q = tree.data.subtree_com[a], tree.data.subtree_com[b]
    return abs(float(p[2] - q[2])) < near < float(np.linalg.norm((p - q)[:2]))


def _chain(tree: Tree, body: int, name: str) -> Chain:
    """The limb that begins with a body."""
    way = tree.way_out(body)
    joints = [j for b in way for j in tree.joints(b)]
    for j in joints:
        tree.must_be_hinge(j)
    bend, sign = _bending(tree, joints, way[-1])
    if name == "leg":
        way = _without_toes(tree, way, joints[bend])
        joints = [j for b in way for j in tree.joints(b)]
    middle = int(tree.model.jnt_bodyid[joints[bend]])
    before = way[: way.index(middle)]
    if not before:
        expected = f"a joint between the trunk and the {name}'s middle joint"
        where = f"joint {tree.name(joints[bend])!r}"
        raise InputError(expected, tree.source, where)
    past = [j for b in tree.below(way[0]) for j in tree.joints(b)]
    return Chain(
        root=before[min(1, len(before) - 1)],
        middle=middle,
        end=way[-1],
        bodies=tuple(way),
        joints=tuple(joints),
        bend=bend,
        sign=sign,
        beyond=tuple(j for j in past if j not in joints),
    )


def _without_toes(tree: Tree, way: list[int], knee: int) -> list[int]:
    """A leg's way out to its foot: toes turn ahead of the ankle, near the sole."""
    at = way.index(int(tree.model.jnt_bodyid[knee]))
    if len(way) < at + 3:
        return way
    place = [tree.data.xanchor[tree.joints(b)[0]] for b in way]
    shank = float(np.linalg.norm(place[at + 1] - place[at]))
    points = tree.points(way[at + 1], below=True)
    low = float(points[:, 2].min()) if len(points) else -np.inf
    for i in range(at + 2, len(way)):
        off = place[i] - place[at + 1]
        lower = place[i][2] - low < TOE_HEIGHT * (place[at + 1][2] - low)
        if lower and np.linalg.norm(off[:2]) > TOE * shank:
            return way[:i]
    return way


def _bending(tree: Tree, joints: list[int], end: int) -> tuple[int, float]:
    """The hinge that is the knee or elbow, and the sign of its flexion.

    That with the largest product of levers: distance of its axis from the limb's second
    joint, the middle of shoulder or hip, times that from its tip. A twist has none on
    one side, an ankle a short one.
    """
    model, data = tree.model, tree.data
    first = data.xanchor[joints[1]]
    points = tree.points(end, below=True)
    if len(points) == 0:
        points = data.xipos[end][None]
    far = points[int(np.argmax(np.linalg.norm(points - first, axis=1)))]
    tip = 0.5 * (far + data.xpos[end])  # fingers do not make a wrist an elbow

    def lever(j: int, p: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(p - data.xanchor[j], data.xaxis[j])))

    # What is before the middle of the shoulder is a collarbone.
    bend = 2 + int(np.argmax([lever(j, first) * lever(j, tip) for j in joints[2:]]))
    local = data.xmat[end].reshape(3, 3).T @ (tip - data.xpos[end])
    angles = np.linspace(*joint_range(model, joints[bend]), SWEEP)
    lengths = []
    for angle in angles:
        turned = _turned(model, joints[bend], float(angle))
        p = turned.xpos[end] + turned.xmat[end].reshape(3, 3) @ local
        lengths.append(float(np.linalg.norm(p - first)))
    fold = angles[int(np.argmin(lengths))] - angles[int(np.argmax(lengths))]
    return bend, float(np.sign(fold)) or 1.0


def _turned(model: mujoco.MjModel, joint: int, angle: float) -> mujoco.MjData:
    """The zero posture but for one joint."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joint]] = angle
    mujoco.mj_kinematics(model, data)
    return data

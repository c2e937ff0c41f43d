"""Which way a description faces, and how a knee folds that may bend both ways.

No sign is sure. Knees may bend both ways, soles be as long behind as ahead, names say
nothing. So each tells with a weight, and where they disagree a person should look.

A hinge about `a` moves what is past it by `a x u`, with u the direction of the
straight limb, from the trunk outwards.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from clamber.model.tree import Chain, Tree, joint_range

# How much each counts where it is clear.
NAMES, SOLES, KNEES, ELBOWS, CAMERAS, ZERO = 3.0, 2.0, 2.0, 1.0, 1.0, 1.0
CLEAR = 0.25  # of a sole's length: as much longer ahead of the ankle than behind
CLOSE = 0.5  # of all that is told: a smaller majority is close
BOTH_WAYS = 0.3  # of its larger range: a knee that bends so far the other way, too
ALONG = 0.5  # cosine: a limb that folds this much ahead or back, not aside
EYES = re.compile(r"camera|realsense|d435|zed|(^|[^a-z])eyes?([^a-z]|$)", re.IGNORECASE)
TWINS = 0.99  # cosine of an axis to the other side's, seen in a mirror
SIDES = (("left", "right"), ("links", "rechts"), ("lft", "rgt"), ("l", "r"))
SOLE_DEPTH = 0.04  # share of the shank: points this near to the lowest are the sole


def side_told(left: str, right: str) -> int:
    """1 where a pair of names says left and right, -1 where right and left."""
    a, b = left.lower(), right.lower()
    for x, y in SIDES:
        for sign, p, q in ((1, a, b), (-1, b, a)):
            ends = [m.end() for m in re.finditer(f"(?={x})", p)]
            if any(p[:i] + y + p[i + len(x) :] == q for i in ends):
                return sign
    return 0


def sides_told(pairs: Iterable[tuple[str, str]]) -> float:
    """From -1 (all pairs of names swapped) over 0 (no evidence) to 1."""
    told = [s for s in (side_told(a, b) for a, b in pairs) if s]
    return float(np.mean(told)) if told else 0.0


def signs_of_ahead(
    tree: Tree, limbs: Mapping[str, Sequence[Chain]], forward: np.ndarray
) -> dict[str, float]:
    """Evidence for which way is forward: positive for `forward`, with weights.

    Args:
        tree: The description.
        limbs: `arm` and `leg`: the chain on the left of `forward`, and the right one.
        forward: (3,) a horizontal unit vector.
    """
    model, data = tree.model, tree.data
    pairs = [
        (kind(model, a), kind(model, b))
        for left, right in limbs.values()
        for kind, xs, ys in (
            (_body_name, left.bodies, right.bodies),
            (_joint_name, left.joints, right.joints),
        )
        for a, b in zip(xs, ys, strict=False)
    ]
    legs, arms = limbs["leg"], limbs["arm"]
    ankles = [data.xanchor[c.joints[min(c.bend + 1, len(c.joints) - 1)]] for c in legs]
    soles = [
        _longer_ahead((sole_points(tree, c) - p) @ forward)
        for c, p in zip(legs, ankles, strict=True)
    ]
    eyes = _looks(tree, [data.xanchor[c.joints[0]] for c in arms], forward)
    return {
        "names of left and right": NAMES * sides_told(pairs),
        "soles": SOLES * float(np.clip(np.mean(soles) / CLEAR, -1, 1)),
        "knees' limits": -KNEES
        * float(np.mean([_folds(tree, c, forward) for c in legs])),
        "elbows' limits": ELBOWS
        * float(np.mean([_folds(tree, c, forward) for c in arms])),
        "cameras": CAMERAS * eyes,
        "the model's x": ZERO * float(forward[0]) * (abs(float(forward[0])) > 0.99),
    }


def said_of_ahead(signs: Mapping[str, float]) -> list[str]:
    """Notes where that evidence, positive for what was taken, disagrees."""
    against = [n for n, x in signs.items() if x < 0]
    lost, all_told = -sum(signs[n] for n in against), sum(map(abs, signs.values()))
    notes = []
    if "names of left and right" in against:
        notes.append(
            "left and right are the other way round than its names say, since"
            f" {_listed(n for n, x in signs.items() if x > 0)} tell so: is it mirrored?"
        )
    if all_told - 2 * lost < CLOSE * all_told:
        told = _listed(n for n, x in signs.items() if x > 0)
        others = _listed(against) or "nothing"
        notes.append(
            f"which way it faces is a close vote: as proposed for {told or 'nothing'},"
            f" the other way for {others}; look at robot.png"
        )
    return notes


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)


def bending_as_people_do(
    tree: Tree, pair: Sequence[Chain], way: np.ndarray
) -> list[Chain]:
    """Limbs that may fold both ways fold `way` (3,): feet back, hands ahead.

    Where that is aside, the right one folds as the left one's mirror image.
    """
    out, aside = [], 0
    for chain in pair:
        low, high = _room(tree, chain)
        both = min(low, high) > BOTH_WAYS * max(low, high)
        along = float(_motion(tree, chain) @ way)
        if both and abs(along) > ALONG:
            chain = replace(chain, sign=float(np.sign(along)))
        out.append(chain)
        aside += both and abs(along) <= ALONG
    left, right = out
    turns = mirrored_turns(tree, left, right, way)
    if aside == len(out) and turns is not None:
        out[1] = replace(right, sign=float(turns[right.bend]) * left.sign)
    return out


def mirrored_turns(
    tree: Tree, left: Chain, right: Chain, forward: np.ndarray
) -> np.ndarray | None:
    """(J,) 1 or -1: right joints' angles by the left ones', as their mirror image.

    None where the limbs' axes are not mirror images of each other at the zero posture.

    Args:
        tree: The description.
        left: A limb of J joints.
        right: Its other side.
        forward: (3,) a horizontal unit vector, of either way.
    """
    if len(left.joints) != len(right.joints):
        return None
    across = np.cross([0.0, 0.0, 1.0], forward)
    a, b = (tree.data.xaxis[list(c.joints)] for c in (left, right))
    mirror = 2.0 * np.outer(a @ across, across) - a  # axes are not vectors
    cosines = np.einsum("ji,ji->j", mirror, b)
    return np.sign(cosines) if np.abs(cosines).min() > TWINS else None


def sole_points(tree: Tree, leg: Chain) -> np.ndarray:
    """(K, 3) points of the sole: of the foot and its toes, near to the lowest."""
    points = tree.points(int(tree.links[leg.end]), below=True)
    if len(points) == 0:
        return points
    low = float(points[:, 2].min())
    shank = float(tree.data.xanchor[leg.elbow][2] - low)
    return points[points[:, 2] < low + SOLE_DEPTH * shank]


def _body_name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name


def _longer_ahead(along: np.ndarray) -> float:
    """Reach of a sole ahead of the ankle less that behind, per its length."""
    if len(along) == 0 or np.ptp(along) < 1e-9:
        return 0.0
    return float((along.max() + along.min()) / np.ptp(along))


def _motion(tree: Tree, chain: Chain) -> np.ndarray:
    """(3,) where a positive turn of knee or elbow moves what is past it, straight."""
    anchor, axis = tree.data.xanchor[chain.elbow], tree.data.xaxis[chain.elbow]
    out = anchor - tree.data.xanchor[chain.joints[min(1, chain.bend)]]
    motion = np.cross(axis, out)
    return motion / max(float(np.linalg.norm(motion)), 1e-9)


def _room(tree: Tree, chain: Chain) -> tuple[float, float]:
    """Range of a knee or elbow from straight: negative and positive side [rad]."""
    data, j = tree.data, chain.elbow
    anchor, axis = data.xanchor[j], data.xaxis[j]
    out = anchor - data.xanchor[chain.joints[min(1, chain.bend)]]
    on = tree.far(chain) - anchor
    straight = float(
        np.arctan2(axis @ np.cross(on, out), out @ on - (out @ axis) * (on @ axis))
    )
    low, high = joint_range(tree.model, j)
    straight = float(np.clip(straight, low, high))
    return straight - low, high - straight


def _folds(tree: Tree, chain: Chain, forward: np.ndarray) -> float:
    """1 where a limb can only flex forward, -1 only back, 0 both ways or sideways."""
    low, high = _room(tree, chain)
    along = float(_motion(tree, chain) @ forward)
    return along * (high - low) / max(high + low, 1e-9)


def _looks(tree: Tree, shoulders: Sequence[np.ndarray], forward: np.ndarray) -> float:
    """1 where cameras look ahead, or are ahead of the shoulders; -1 behind them."""
    model, data = tree.model, tree.data
    looks = [
        float(-data.cam_xmat[c].reshape(3, 3)[:, 2] @ forward)
        for c in range(model.ncam)
        if model.cam_mode[c] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED
        and tree.hangs_on(int(model.cam_bodyid[c]), tree.base)
        and np.linalg.norm(model.cam_pos[c]) < 0.3
    ]
    middle, near = np.mean(shoulders, axis=0), 0.02 * float(np.ptp(data.xipos[1:, 2]))
    for b in range(1, model.nbody):
        ahead = float((data.xpos[b] - middle) @ forward)
        if EYES.search(model.body(b).name) and abs(ahead) > near:
            looks.append(float(np.sign(ahead)))
    return float(np.clip(np.sum(looks), -1, 1)) if looks else 0.0

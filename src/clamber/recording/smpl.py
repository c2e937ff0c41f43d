"""SMPL bodies: joints from pose and shape parameters and a body model file.

`poses`, `trans` and `betas`, as AMASS has them, say how a body is bent, not where its
joints are: those come from the licensed model's mean shape and joint regressor.

    J = R_J (v_mean + S beta),  p_j = p_parent + R_parent (J_j - J_parent)

Shapes: T samples, J joints, V vertices, B shape parameters.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from clamber.errors import InputError, check_kind
from clamber.recording.pickles import as_array, read_pickle
from clamber.recording.points import Points

# Joints of the SMPL bodies, in order; arrays of them often come without names.
_BODY = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle "
    "right_ankle spine3 left_foot right_foot neck left_collar right_collar head "
    "left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()
_FINGERS = [
    f"{{side}}_{f}{k}" for f in ("index", "middle", "pinky", "ring", "thumb")
    for k in (1, 2, 3)
]  # fmt: skip
_HANDS = [f.format(side=s) for s in ("left", "right") for f in _FINGERS]
JOINTS = {
    22: ("SMPL body", _BODY),
    24: ("SMPL", [*_BODY, "left_hand", "right_hand"]),
    52: ("SMPL-H", [*_BODY, *_HANDS]),
    55: ("SMPL-X", [*_BODY, "jaw", "left_eye_smplhf", "right_eye_smplhf", *_HANDS]),
}
_POSE, _BENT = ("poses",), ("pose_body", "body_pose")
_TURN = ("root_orient", "global_orient", "root_pose")
_PLACE = ("trans", "transl")
_RATE = ("mocap_framerate", "mocap_frame_rate", "fps", "rate")
WORDS = {*_POSE, *_BENT, *_TURN, *_PLACE, *_RATE, "betas"}
NEEDS_MODEL = (
    "joints in the file, or the body model beside it: poses, trans and betas alone say "
    "no positions; --body-model FILE (body_model in a recording.yaml) names SMPL's, "
    "SMPL-H's or SMPL-X's .npz or .pkl, which their authors license"
)


def are_parameters(found: Mapping[str, object]) -> bool:
    """Whether a file holds parameters of a body."""
    return bool({*_POSE, *_BENT} & found.keys())


def read_body(
    found: Mapping[str, object], model: Path | None, rate: float | None, path: Path
) -> Points:
    """Joints of a body's parameters.

    Args:
        found: Of the file, by name.
        model: The body model's file.
        rate: In place of the file's own [Hz].
        path: The file, for messages.

    Raises:
        InputError: No model is named, or file or model cannot be used.
    """
    if model is None:
        raise InputError(NEEDS_MODEL, path, "poses")
    try:
        pose, place, betas = _parameters(found)
        if rate is None:
            said = next((found[w] for w in _RATE if w in found), None)
            if said is None:
                raise InputError("a value: the file has none", path, "rate")
            rate = float(as_array(said).ravel()[0])
    except (ValueError, TypeError, IndexError) as e:
        raise InputError(f"parameters of a body ({e})", path, "poses") from e
    rest, parents = _load_model(model, betas)
    joints = len(rest)
    if joints not in JOINTS:
        expected = f"a body model of {sorted(JOINTS)} joints"
        raise InputError(expected, model, "J_regressor", joints)
    kind, names = JOINTS[joints]
    # Joints of the body are the same in all; fingers and faces differ.
    used = joints if pose.shape[1] == joints else min(len(_BODY), pose.shape[1])
    angles = np.zeros((len(pose), joints, 3))
    angles[:, :used] = pose[:, :used]
    position = _kinematics(angles, rest, parents) + place[:, None]
    notes = [f"joints by the {kind} model {model.name} from {pose.shape[1]} rotations"]
    if pose.shape[1] not in (22, joints):
        notes.append(
            f"the file's {pose.shape[1]} rotations are not the model's {joints}"
        )
    return Points(names=tuple(names), position=position, rate=rate, unit=1.0,
                  notes=tuple(notes))  # fmt: skip


def _parameters(
    found: Mapping[str, object],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (T, K, 3) from the pelvis on, its places (T, 3), shape (B,)."""
    if "poses" in found:
        pose = as_array(found["poses"])
    else:
        body = next(found[k] for k in _BENT if k in found)
        root = next((found[k] for k in _TURN if k in found), None)
        pose = as_array(body).reshape(len(as_array(body)), -1)
        if root is None:
            raise ValueError("no root_orient")
        pose = np.concatenate([as_array(root).reshape(len(pose), 3), pose], axis=1)
    pose = pose.reshape(len(pose), -1, 3)
    place = next((found[k] for k in _PLACE if k in found), None)
    if place is None:
        raise ValueError("no trans")
    place = as_array(place).reshape(len(pose), 3)
    betas = as_array(found["betas"]) if "betas" in found else np.zeros(1)
    betas = betas.reshape(-1, betas.shape[-1] if betas.ndim else 1)[0]
    return pose, place, betas


def _load_model(path: Path, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints at rest (J, 3) [m] of a shape, and their parents (J,)."""
    start = check_kind(path, "a body model, .npz or .pkl", "npz", "pickle")
    try:
        if start[:2] == b"PK":
            with np.load(path, allow_pickle=False) as z:
                words = ("v_template", "shapedirs", "J_regressor", "kintree_table")
                model: object = {w: z[w] for w in words if w in z}
        else:
            model = read_pickle(path)
        if not isinstance(model, Mapping):
            raise ValueError("no mapping of arrays")
        mean, shapes, regressor = (
            as_array(model[w]) for w in ("v_template", "shapedirs", "J_regressor")
        )
        parents = as_array(model["kintree_table"])[0].astype(np.int64)
    except KeyError as e:
        raise InputError("a body model", path, str(e.args[0])) from e
    except (ValueError, OSError, zipfile.BadZipFile, IndexError) as e:
        raise InputError(f"a body model ({str(e)[:80]})", path) from e
    v, joints = len(mean), len(regressor)
    fits = mean.shape == (v, 3) and shapes.ndim == 3 and shapes.shape[:2] == (v, 3)
    if not fits or regressor.shape != (joints, v) or len(parents) != joints:
        expected = "arrays (V, 3), (V, 3, B), (J, V) and (2, J) of one body"
        shown = [mean.shape, shapes.shape, regressor.shape, parents.shape]
        raise InputError(expected, path, "v_template, shapedirs ...", shown)
    if np.any(parents[1:] >= np.arange(1, joints)) or np.any(parents[1:] < 0):
        raise InputError("parents before their children", path, "kintree_table")
    used = min(len(betas), shapes.shape[2])
    rest = regressor @ (mean + shapes[:, :, :used] @ betas[:used])
    return rest, parents


def _kinematics(
    angles: np.ndarray, rest: np.ndarray, parents: np.ndarray
) -> np.ndarray:
    """(T, J, 3) joints for rotation vectors (T, J, 3), the pelvis at its rest place."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(angles.reshape(-1, 3))
    R = turns.as_matrix().reshape(*angles.shape, 3)
    out = np.empty_like(angles)
    out[:, 0] = rest[0]
    turned = [R[:, 0]]
    for j in range(1, len(rest)):
        above = turned[parents[j]]
        out[:, j] = out[:, parents[j]] + above @ (rest[j] - rest[parents[j]])
        turned.append(above @ R[:, j])
    return out

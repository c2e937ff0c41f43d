"""Recordings as other programs write them, of any motion."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from clamber.model.boxes import AXES
from clamber.model.se3 import matrix_from_rpy
from clamber.recording.demonstration import Demonstration


def from_z_up(x: np.ndarray, up: str) -> np.ndarray:
    """The inverse of what the readers do."""
    out = np.empty_like(x)
    for k, (axis, sign) in enumerate(AXES[up]):
        out[..., axis] = sign * x[..., k]
    return out


MOTIVE = {
    "Pelvis": "Hip", "Neck": "Neck", "Head": "Head", "Shoulder": "UArm",
    "Elbow": "FArm", "Hand": "Hand", "Hand.knuckle": "Middle1", "Hand.tip": "Middle3",
    "Hip": "Thigh", "Knee": "Shin", "Foot": "Foot", "Foot.toe": "Toe",
}  # fmt: skip
MIXAMO = {
    "Pelvis": "Hips", "Neck": "Neck", "Head": "Head", "Shoulder": "Arm",
    "Elbow": "ForeArm", "Hand": "Hand", "Hand.knuckle": "HandMiddle1",
    "Hand.tip": "HandMiddle3", "Hip": "UpLeg", "Knee": "Leg", "Foot": "Foot",
    "Foot.toe": "ToeBase",
}  # fmt: skip


def renamed(demo: Demonstration, words: dict[str, str], sides=("L", "R")) -> list[str]:
    """The demonstration's names in another skeleton's words."""
    side = dict(zip("LR", sides, strict=True))
    return [words[n] if n in words else side[n[0]] + words[n[1:]] for n in demo.names]


def holed(demo: Demonstration) -> np.ndarray:
    """(T, F, 3) with NaN where the demonstration has seen nothing."""
    return np.where(demo.valid[..., None], demo.position, np.nan)


def motive_csv(
    names: list[str],
    p: np.ndarray,
    *,
    rate: float,
    unit: str = "Meters",
    kind: str = "Bone",
    quaternion: np.ndarray | None = None,
    parent: bool = False,
) -> str:
    """Text as Motive writes it: (T, F, 3) y up, (T, F, 4) wxyz written X Y Z W."""
    width = 3 if quaternion is None else 7
    turned = 0 if quaternion is None else 4
    lines = [
        f"Format Version,1.23,Take Name,take,Take Notes,,Capture Frame Rate,{rate:.6f},"
        f"Export Frame Rate,{rate:.6f},Rotation Type,Quaternion,Length Units,{unit},"
        "Coordinate Space,Global",
        "",
        ",".join([",Type", *[kind] * (width * len(names))]),
        ",".join([",Name", *(n for n in names for _ in range(width))]),
        ",".join([",ID", *['"9E20:1"'] * (width * len(names))]),
    ]
    if parent:
        lines.append(",".join([",Parent", *["Root"] * (width * len(names))]))
    measures = ["Rotation"] * turned + ["Position"] * 3
    lines.append(",".join([",", *measures * len(names)]))
    axes = [*"XYZW"[:turned], *"XYZ"]
    lines.append(",".join(["Frame,Time (Seconds)", *axes * len(names)]))
    for k in range(len(p)):
        cells = [str(k + 72210), f"{k / rate:.6f}"]
        for f in range(len(names)):
            if quaternion is not None:
                w, x, y, z = quaternion[k, f]
                cells += [f"{v:.9f}" for v in (x, y, z, w)]
            seen = np.isfinite(p[k, f]).all()
            cells += [f"{v:.6f}" for v in p[k, f]] if seen else [""] * 3
        lines.append(",".join(cells))
    return "\r\n".join(lines) + "\r\n"


PARENT = {
    "Pelvis": None, "Neck": "Pelvis", "Head": "Neck", "Shoulder": "Neck",
    "Elbow": "Shoulder", "Hand": "Elbow", "Hand.knuckle": "Hand",
    "Hand.tip": "Hand.knuckle", "Hip": "Pelvis", "Knee": "Hip", "Foot": "Knee",
    "Foot.toe": "Foot",
}  # fmt: skip


def bvh_text(demo: Demonstration, p: np.ndarray, order: str) -> str:
    """A hierarchy that turns at random and still puts every joint where it was.

    Local position = R_parent^-1 (p - p_parent), local angles of R_parent^-1 R.
    """
    rng = np.random.default_rng(3)
    index = {n: i for i, n in enumerate(demo.names)}
    called = renamed(demo, MIXAMO, ("Left", "Right"))
    t = np.linspace(0.0, 6.0, len(p))[:, None]
    R = {
        n: Rotation.from_rotvec(np.sin(t * rng.uniform(1, 3, 3) + rng.uniform(0, 6, 3)))
        for n in demo.names
    }
    up = {n: PARENT[n] if n in PARENT else PARENT[n[1:]] for n in demo.names}
    up = {
        n: (n[0] + u if u and n[0] + u in index and n not in PARENT else u)
        for n, u in up.items()
    }
    text, columns = "HIERARCHY\n", []

    def add(name: str, depth: int) -> None:
        nonlocal text
        pad, above = "\t" * depth, up[name]
        local, turn = p[:, index[name]], R[name]
        if above is not None:
            local = R[above].inv().apply(local - p[:, index[above]])
            turn = R[above].inv() * turn
        text += f"{pad}{'JOINT' if above else 'ROOT'} {called[index[name]]}\n{pad}{{\n"
        text += f"{pad}\tOFFSET 0.0 0.0 0.0\n{pad}\tCHANNELS 6 Xposition Yposition "
        text += "Zposition " + " ".join(f"{a}rotation" for a in order) + "\n"
        columns.extend([local, turn.as_euler(order, degrees=True)])
        below = [n for n in demo.names if up[n] == name]
        for n in below:
            add(n, depth + 1)
        if not below:
            text += f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\t\tOFFSET 0 1 0\n{pad}\t}}\n"
        text += pad + "}\n"

    add("Pelvis", 0)
    rows = np.concatenate(columns, axis=1)
    text += f"MOTION\nFrames: {len(p)}\nFrame Time: {1.0 / demo.rate:.9f}\n"
    return text + "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows)


def write_take(demo: Demonstration, path: Path) -> None:
    """The demonstration as C3D or TRC, in mm; what was not seen long is missing."""
    p = 1000.0 * holed(demo)
    if path.suffix == ".c3d":
        path.write_bytes(c3d_bytes(p, demo.names, rate=demo.rate, screen="+Z"))
    else:
        path.write_text(trc_text(from_z_up(p, "y"), demo.names, demo.rate))


def trc_text(p: np.ndarray, names: Sequence[str], rate: float) -> str:
    """TRC in mm; NaN is not seen."""
    n, f = p.shape[:2]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\ttake.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"{rate:.10g}\t{rate:.10g}\t{n}\t{f}\tmm",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{k}" for k in range(1, f + 1) for a in "XYZ"),
        "",
    ]
    for k, row in enumerate(p.reshape(n, -1).tolist()):
        cells = ["" if x != x else f"{x:.4f}" for x in row]
        lines.append("\t".join([str(k + 1), f"{k / rate:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def c3d_bytes(
    p: np.ndarray,
    names: Sequence[str],
    *,
    rate: float = 50.0,
    order: str = "intel",
    scale: float = -1.0,
    analog: int = 0,
    results: Sequence[str] = (),
    screen: str = "",
) -> bytes:
    """A C3D from the format's description, of (T, F, 3) in mm; NaN is not seen.

    Args:
        p: Positions.
        names: Of the points.
        rate: Samples per second [Hz].
        order: `intel`, `dec` or `mips`.
        scale: Of integers; negative for floats.
        analog: How many numbers of other devices stand beside each sample.
        results: Names that are results of models, not markers.
        screen: The axis that points up, such as `+Z`.
    """
    e = ">" if order == "mips" else "<"

    def f4(x) -> bytes:
        raw = np.asarray(x, dtype="<f4")
        if order == "dec":
            words = (raw * np.float32(4.0)).view("<u2").reshape(-1, 2)[:, ::-1]
            return np.ascontiguousarray(words).tobytes()
        return raw.astype(f"{e}f4").tobytes()

    def parameter(name: str, group: int, kind: int, sizes: list[int], data: bytes):
        body = struct.pack("bB", kind, len(sizes)) + bytes(sizes) + data + b"\0"
        step = struct.pack(f"{e}h", len(body) + 2)
        return struct.pack("bb", len(name), group) + name.encode() + step + body

    group = b"POINT"
    parts = struct.pack("bb", len(group), -1) + group + struct.pack(f"{e}h", 3) + b"\0"
    wide = max(len(n) for n in names)
    labels = b"".join(n.encode().ljust(wide) for n in names)
    parts += parameter("LABELS", 1, -1, [wide, len(names)], labels)
    text = b"".join(n.encode().ljust(wide) for n in results)
    parts += parameter("ANGLES", 1, -1, [wide, len(results)], text)
    parts += parameter("UNITS", 1, -1, [2], b"mm")
    parts += parameter("RATE", 1, 4, [], f4([rate]))
    if screen:
        parts += parameter("Y_SCREEN", 1, -1, [len(screen)], screen.encode())
    n, f = p.shape[:2]
    parts += struct.pack("bb", 5, -2) + b"TRIAL" + struct.pack(f"{e}h", 3) + b"\0"
    for name, k in (("ACTUAL_START_FIELD", 1), ("ACTUAL_END_FIELD", n)):
        halves = struct.pack(f"{e}2H", k & 0xFFFF, k >> 16)
        parts += parameter(name, 2, 2, [2], halves)
    processor = {"intel": 84, "dec": 85, "mips": 86}[order]
    blocks = -(-(4 + len(parts) + 2) // 512)
    section = bytes([1, 0x50, blocks, processor]) + parts
    section = section.ljust(512 * blocks, b"\0")
    values = np.zeros((n, f, 4))
    values[..., :3] = np.nan_to_num(p)
    values[..., 3] = np.where(np.isnan(p).any(axis=2), -1, 0)
    if scale > 0:
        values[..., :3] /= scale
        rows = np.concatenate([values.reshape(n, -1), np.full((n, analog), 7)], axis=1)
        data = np.rint(rows).astype(f"{e}i2").tobytes()
    else:
        rows = np.concatenate([values.reshape(n, -1), np.full((n, analog), 7)], axis=1)
        data = f4(rows.ravel())
    head = bytes([2, 0x50]) + struct.pack(f"{e}HHHHH", f, analog, 1, min(n, 65535), 0)
    head += f4([scale]) + struct.pack(f"{e}HH", 2 + blocks, 0) + f4([rate])
    return head.ljust(512, b"\0") + section + data


def smpl_joints(demo: Demonstration, joints: int) -> np.ndarray:
    """(T, joints, 3) in the order of SMPL's joints; those it lacks are the pelvis."""
    p = np.zeros((len(demo.t), joints, 3))
    order = (
        "Pelvis LHip RHip . LKnee RKnee . LFoot RFoot . LFoot.toe RFoot.toe Neck . . "
        "Head LShoulder RShoulder LElbow RElbow LHand RHand"
    ).split()
    for k, n in enumerate(order):
        p[:, k] = demo.point("Pelvis" if n == "." else n)
    for s, side in enumerate("LR"):
        if joints == 24:
            p[:, 22 + s] = demo.point(side + "Hand.knuckle")
        if joints == 55:
            fingers = slice(25 + 15 * s, 40 + 15 * s)
            p[:, fingers] = demo.point(side + "Hand.knuckle")[:, None]
            p[:, 30 + 15 * s] = demo.point(side + "Hand.tip")  # middle3
    return p


def skin_markers(demo: Demonstration) -> tuple[list[str], np.ndarray]:
    """Plug-in Gait's markers on the person's skin, from the true joint centres."""
    at = {n: demo.point(n) for n in demo.names}

    def unit(v):
        return v / np.linalg.norm(v, axis=1, keepdims=True)

    hips, width = (
        (at["LHip"] + at["RHip"]) / 2,
        np.median(np.linalg.norm(at["LHip"] - at["RHip"], axis=1)),
    )
    left = unit(at["LHip"] - at["RHip"])
    up = at["Neck"] - hips
    up = unit(up - left * np.sum(up * left, axis=1, keepdims=True))
    forward = np.cross(left, up)
    across, depth = (width / 2 - 0.0073) / 0.33, 0.15
    front = hips + (0.24 * depth + 0.0099) * forward + (0.3 * across + 0.0109) * up
    shoulders = np.median(np.linalg.norm(at["LShoulder"] - at["RShoulder"], axis=1))
    out = {"C7": at["Neck"]}
    for s, sign in (("L", 1.0), ("R", -1.0)):
        out[f"{s}ASI"] = front + sign * across / 2 * left
        out[f"{s}PSI"] = front - depth * forward + sign * 0.04 * left
        out[f"{s}FHD"] = at["Head"] + 0.07 * (forward + sign * left)
        out[f"{s}BHD"] = at["Head"] - 0.07 * (forward - sign * left)
        for marker, joint, above, share in (
            ("KNE", "Knee", "Hip", 0.125), ("ANK", "Foot", "Knee", 0.08)
        ):  # fmt: skip
            bone = unit(at[s + joint] - at[s + above])
            side = unit(left - bone * np.sum(left * bone, axis=1, keepdims=True))
            length = np.linalg.norm(at[s + joint] - at[s + above], axis=1)[0]
            out[s + marker] = at[s + joint] + sign * (share * length + 0.007) * side
        out[f"{s}TOE"] = at[f"{s}Foot.toe"] + [0, 0, 0.02]
        out[f"{s}SHO"] = at[f"{s}Shoulder"] + 0.17 * shoulders * up
        out[f"{s}ELB"] = at[f"{s}Elbow"]
        out[f"{s}WRA"] = at[f"{s}Hand"] + 0.03 * left
        out[f"{s}WRB"] = at[f"{s}Hand"] - 0.03 * left
        out[f"{s}FIN"] = at[f"{s}Hand.knuckle"] + [0, 0, 0.02]
    return list(out), np.stack(list(out.values()), axis=1)


def box_obj(size, centre, yaw, first: int = 1, name: str | None = None) -> str:
    """Eight vertices of an upright box in an order of no meaning."""
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T * size
    v = corners @ matrix_from_rpy([0, 0, yaw]).T + centre
    v = v[np.random.default_rng(first).permutation(8)]
    lines = [] if name is None else [f"o {name}"]
    return "\n".join([*lines, *(f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in v), ""])

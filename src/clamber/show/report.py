"""Run folder -> one HTML file: an animation to turn and scrub, plots and tables.

The file fetches nothing. Python reads the records, samples the motion and writes it as
packed arrays into a template; what is drawn from them is in `web/`: `scene.js` is the
renderer, `report.js` builds the page. Names in a run folder are somebody's input: they
travel as JSON that cannot end its element, and are set as text alone; a content
security policy runs our script and no other.

A run whose files are broken or missing is shown as far as it can be read.

Shapes: n samples, nb drawn bodies, nS surfaces, na joints, K keyframes.
"""

from __future__ import annotations

import base64
import hashlib
import html
import importlib.metadata
import io as bytes_io
import json
import math
import string
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from clamber.errors import InputError
from clamber.execution.simulation import Rollout
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.progress import Progress, silent
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.run.codec import whole_file
from clamber.run.folder import PLAN, RUN_MAKERS, VERDICT, fallback_note
from clamber.show.framing import PRESETS, box_corners, seen_points
from clamber.show.marks import FORCE_LENGTH
from clamber.show.meshes import Mesh, body_meshes, body_poses, pads_of
from clamber.show.sample import (
    keyframe_times,
    read_run,
    sample_motion,
    stance_rows,
)

REPORT = "report.html"
PERSON = "demonstration.png"  # of the recording, which is not in the folder
READING = 0.4  # of the time that a report takes
MAX_PICTURE = 1_000_000  # [bytes] larger ones are left out
MAX_POSES = (
    1_200_000  # [bytes] of one run's poses; longer runs are sampled more coarsely
)
SHARP = 32767  # the largest packed number; one below the smallest stands for none


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reported:
    """The report that was written.

    Attributes:
        file: The HTML file.
        missing: A sentence for each file that could not be shown.
    """

    file: Path
    missing: tuple[str, ...]


@checks_types
def write_report(
    folder: str | Path,
    *,
    compare: str | Path | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Reported:
    """Write the report of a run as one HTML file.

    Args:
        folder: A run folder, complete or not.
        compare: Another one, shown beside it.
        out: The file; `report.html` in the run folder by default.
        progress: Called with stage, share and note.

    Raises:
        InputError: There is nothing to show in a folder, or the file cannot be written.
    """
    folder = Path(folder)
    runs = [folder] if compare is None else [folder, Path(compare)]
    tell = progress or silent
    shown = []
    for k, run in enumerate(runs):

        def of_all(done: float, note: str, k: int = k) -> None:
            tell("report", (k + done) / len(runs), note)

        shown.append(run_record(run, of_all))
    file = folder / REPORT if out is None else Path(out)
    try:
        with whole_file(file) as draft:
            draft.write_text(page(shown), encoding="utf-8")
    except OSError as e:
        raise InputError(
            f"a file that can be written ({e.strerror or e})",
            source="--out",
            value=str(file),
        ) from e
    missing = [text for record in shown for text in record["missing"]]
    return Reported(file=file, missing=tuple(missing))


def page(runs: Iterable[Mapping[str, Any]]) -> str:
    """The HTML of some run records, one or two."""
    runs = list(runs)
    web = files("clamber.show") / "web"
    read = {n: (web / n).read_text("utf-8") for n in ("report.html", "report.css")}
    script = "\n".join((web / n).read_text("utf-8") for n in ("scene.js", "report.js"))
    presets = [
        {"name": n, "azimuth": a, "elevation": e} for n, (a, e) in PRESETS.items()
    ]
    data = {
        "version": importlib.metadata.version("clamber"),
        "presets": presets,
        "runs": runs,
    }
    digest = hashlib.sha256(script.encode()).digest()
    return string.Template(read["report.html"]).substitute(
        title=html.escape(" against ".join(str(r["title"]) for r in runs)),
        style=read["report.css"],
        script=script,
        hash=base64.b64encode(digest).decode(),
        data=embedded(data),
    )


def embedded(data: Any) -> str:
    """JSON that can lie in a script element: nothing in it can end that element."""
    text = json.dumps(_finite(data), allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _finite(x: Any) -> Any:
    """The same, with null for numbers that are not finite."""
    if isinstance(x, Mapping):
        return {str(k): _finite(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_finite(v) for v in x]
    if isinstance(x, np.ndarray):
        return _finite(x.tolist())
    if isinstance(x, np.generic):
        x = x.item()
    return None if isinstance(x, float) and not math.isfinite(x) else x


# What a folder holds.


def run_record(
    folder: Path, tell: Callable[[float, str], None] = lambda done, note: None
) -> dict[str, Any]:
    """All that the page shows of a run, as plain values.

    Args:
        folder: The run's.
        tell: Called with the share done and a note.

    Raises:
        InputError: It is no folder, or nothing in it can be read.
    """
    tell(0.0, f"reading {folder}")
    run = read_run(folder)
    written, plan, rollout = run.written, run.plan, run.rollout
    picture = run.attempt(lambda: _picture(folder / PERSON))
    if not (written or run.verdict or run.execution or picture):
        raise InputError(
            f"a run folder with a whole {PLAN} or {VERDICT}; {RUN_MAKERS}",
            source=folder,
        )
    motion = None
    times: list[float | None] = [None] * len(written.get("keyframes", []))
    if plan is not None:
        tell(READING, "stability")
        motion = _motion(
            plan,
            rollout,
            run.execution,
            lambda done: tell(READING + (1.0 - READING) * done, "stability"),
        )
        times = keyframe_times(plan, rollout)
    name = written.get("robot", {}).get("name")
    place = folder.resolve().name
    return {
        "title": f"{name}: {place}" if name else place,
        "facts": _facts(written),
        "mass": None if plan is None else plan.world.mass,
        "missing": run.missing,
        "reached": None if run.verdict is None else run.verdict.reached,
        "criteria": None if run.verdict is None else run.verdict.rows(),
        "events": run.execution.get("events", []),
        "stopped": run.execution.get("stopped", ""),
        "fell": run.execution.get("fell", False),
        "adapted": rollout is not None
        and rollout.followed is not None
        and bool(rollout.events),
        "instead": fallback_note(written),
        "keyframes": stance_rows(written, times),
        "skipped": [*written.get("skipped", ()), *written.get("failures", ())],
        "options": _flat(written.get("options")),
        "versions": _flat(written.get("versions")),
        "inputs": _flat(written.get("inputs")),
        "timings": [(k, round(v, 3)) for k, v in _flat(run.timings.get("seconds"))],
        "picture": picture,
        "motion": motion,
    }


def _facts(written: Mapping[str, Any]) -> list[str]:
    """The scene in a few words."""
    boxes = written.get("sequence", {}).get("scene", {}).get("boxes", [])
    return [
        f"{b['name']} {' x '.join(f'{x:g}' for x in b['size'])} m, friction "
        f"{b['friction']:g}"
        for b in boxes[:3]
    ]


def _flat(x: Any, name: str = "") -> list[tuple[str, Any]]:
    """Dotted names and values of what may be nested."""
    if isinstance(x, Mapping):
        rows = [_flat(v, f"{name}.{k}" if name else str(k)) for k, v in x.items()]
        return [pair for row in rows for pair in row]
    if x is None and not name:
        return []
    return [(name, x if isinstance(x, (int, float, str)) else json.dumps(x))]


def _picture(path: Path) -> str | None:
    """A PNG as a data URL; None where there is none, or one too large to carry.

    Raises:
        InputError: It is no picture.
    """
    if not path.is_file() or path.stat().st_size > MAX_PICTURE:
        return None
    content = path.read_bytes()
    try:
        with Image.open(bytes_io.BytesIO(content), formats=("PNG",)) as picture:
            picture.verify()
    except (OSError, SyntaxError, ValueError) as e:
        raise InputError("a whole PNG picture", source=path) from e
    return f"data:image/png;base64,{base64.b64encode(content).decode()}"


# The motion, sampled and packed.


def _motion(
    plan: Plan,
    rollout: Rollout | None,
    execution: Mapping[str, Any],
    tell: Callable[[float], None],
) -> dict[str, Any]:
    """Data of the animation and the plots."""
    world = plan.world if rollout is None else rollout.world
    meshes = body_meshes(world.model, pads=pads_of(world))
    most = max(2, MAX_POSES // (28 * max(len(meshes), 1)))
    m = sample_motion(plan, rollout, execution, most, tell)
    series: dict[str, np.ndarray | None] = {
        "loaded": m.loaded,
        "force": m.force,
        "size": m.size,
        "effort": m.effort,
        "planned": m.planned,
        "push": m.push,
        "pushSize": m.push_size,
        "base": None if m.push is None else m.q[:, :3],
        "points": m.points,
        "support": m.support,
        "ratio": m.distance / m.limit,
        "margin": m.margin,
        "plannedMargin": m.planned_margin,
        "error": m.error,
    }
    kin = Kinematics(world)
    poses = _poses(kin, meshes, m.q)
    ghost = None if m.reference is None else _poses(kin, meshes, m.reference)
    keyposes = _poses(kin, meshes, np.array([k.q for k in plan.keyframes]))
    shown = [x for x in (poses, ghost, keyposes) if x is not None]
    reach = max(1e-3, *(float(np.abs(x[..., :3]).max()) for x in shown))
    for x in shown:
        x[..., :3] /= reach
    arrays = {n: None if x is None else packed(x) for n, x in series.items()}
    for name, x in (("poses", poses), ("ghost", ghost), ("keyposes", keyposes)):
        arrays[name] = None if x is None else packed(x, largest=1.0)
    return {
        "stills": m.stills,
        "times": _base64(m.time, "<f4"),
        "arrays": arrays,
        "meshes": [_mesh_record(x) for x in meshes],
        "edges": _box_edges(world.model, world.scene),
        "seen": seen_points(kin, m.q),
        "start": float(world.scene.start[2]),
        "reach": reach,
        "weight": world.mass * 9.81,
        "forceLength": FORCE_LENGTH,
        "surfaces": list(world.surfaces),
        "arms": [world.robot.limb_of(s).is_arm for s in world.surfaces],
        "supports": [
            {"name": s.name, "height": float(s.position[2]), "normal": s.normal}
            for s in world.supports.values()
        ],
        "joints": list(world.joints),
        "effortLimits": world.tau_max,
        "marginAsked": plan.options.keyframe.balance_margin * world.length_scale,
        "schedule": m.schedule,
        "loads": m.loads,
        "events": m.events,
        "felt": m.felt,
    }


def _poses(kin: Kinematics, meshes: list[Mesh], q: np.ndarray) -> np.ndarray:
    """(n, nb, 7) position [m] and unit quaternion of the drawn bodies."""
    out = np.zeros((len(q), len(meshes), 7))
    for i, posture in enumerate(q):
        kin.update(posture)
        out[i] = body_poses(kin.data, meshes)
    return out


def _box_edges(model: mujoco.MjModel, scene: Scene) -> list[float]:
    """Ends of the edges of boxes and of supports of meshes [m], 6 numbers an edge."""
    ends = [(a, b) for a in range(8) for b in (a | 1, a | 2, a | 4) if b > a]
    out: list[float] = []
    for g in np.flatnonzero(model.geom_bodyid == 0):
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_BOX:
            continue
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[g])
        size = 2 * model.geom_size[g]
        points = box_corners(size, model.geom_pos[g], R.reshape(3, 3))
        out += np.round(points[np.array(ends)], 5).ravel().tolist()
    for s in (s for m in scene.meshes for s in m.supports):
        lines = np.stack([s.vertices, np.roll(s.vertices, -1, axis=0)], axis=1)
        out += np.round(lines, 5).ravel().tolist()
    return out


def _mesh_record(mesh: Mesh) -> dict[str, Any]:
    scale = max(1e-6, float(np.abs(mesh.vertices).max()) / SHARP)
    return {
        "body": mesh.body,
        "scale": scale,
        "vertices": _base64(np.round(mesh.vertices / scale), "<i2"),
        "normals": _base64(np.round(mesh.normals * 127), "i1"),
        "colours": _base64(np.round(np.clip(mesh.colours, 0, 1) * 255), "u1"),
        "triangles": _base64(mesh.triangles, "<u4"),
    }


def packed(x: np.ndarray, *, largest: float | None = None) -> dict[str, Any]:
    """An array as 16-bit multiples of one scale; what is not finite as -32768.

    Args:
        x: (n, ...).
        largest: Magnitude that the scale is made for; the largest there is by default.
    """
    x = np.asarray(x, dtype=float).reshape(len(x), -1)
    known = np.isfinite(x)
    if largest is None:
        largest = float(np.abs(x[known]).max(initial=0.0))
    scale = largest / SHARP or 1.0
    whole = np.where(known, np.round(np.where(known, x, 0.0) / scale), -SHARP - 1)
    return {
        "columns": x.shape[1],
        "scale": scale,
        "data": _base64(np.clip(whole, -SHARP - 1, SHARP), "<i2"),
    }


def _base64(x: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(x).astype(dtype).tobytes()).decode()

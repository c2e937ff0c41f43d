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
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from PIL import Image

from clamber.contact import Contact
from clamber.errors import ClamberError, InputError
from clamber.io import (
    EXECUTION,
    PLAN,
    ROLLOUT,
    RUN_MAKERS,
    SCENE,
    TIMINGS,
    TRAJECTORY,
    VERDICT,
    load_fields,
    load_plan,
    load_rollout,
    whole_file,
)
from clamber.meshes import Mesh, body_meshes
from clamber.model import Kinematics, World
from clamber.pipeline import Plan
from clamber.simulation import Rollout
from clamber.trajectory import Trajectory
from clamber.viz import (
    FORCE_LENGTH,
    PRESETS,
    describe_move,
    loaded_surfaces,
    near_edge_points,
    robot_corners,
    runs_of,
    stability_of,
    support_below,
)

REPORT = "report.html"
PERSON = "demonstration.png"  # of the recording, which is not in the folder
MAX_PICTURE = 1_000_000  # [bytes] larger ones are left out
SAMPLES_A_SECOND = 25
MAX_POSES = (
    1_200_000  # [bytes] of one run's poses; longer runs are sampled more coarsely
)
SAME_POSTURE = 1e-3  # [rad]
SHORTEST_LOAD = 0.06  # [s] a shorter touch, or gap, is none
SHARP = 32767  # the largest packed number; one below the smallest stands for none
_Loaded = TypeVar("_Loaded")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reported:
    """What was written.

    Attributes:
        file: The page.
        missing: A sentence for each file that could not be shown.
    """

    file: Path
    missing: tuple[str, ...]


def write_report(
    folder: str | Path,
    *,
    compare: str | Path | None = None,
    out: str | Path | None = None,
) -> Reported:
    """Write the report of a run as one HTML file.

    Args:
        folder: A run folder, whole or not.
        compare: Another one, laid beside it.
        out: The file; `report.html` in the run folder by default.

    Raises:
        InputError: There is nothing to show in a folder, or the file cannot be written.
    """
    folder = Path(folder)
    runs = [folder] if compare is None else [folder, Path(compare)]
    shown = [run_record(f) for f in runs]
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
    web = files("clamber") / "web"
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


@dataclass(eq=False, slots=True)
class _Reading:
    """Reads what can be read of a folder and keeps why the rest could not."""

    folder: Path
    missing: list[str] = field(default_factory=list)

    def attempt(self, load: Callable[[], _Loaded]) -> _Loaded | None:
        try:
            return load()
        except ClamberError as e:
            text = str(e).replace(f"{self.folder}/", "")
            if text not in self.missing:
                self.missing.append(text)
            return None

    def fields(self, name: str) -> dict[str, Any]:
        return self.attempt(lambda: load_fields(self.folder, name)) or {}

    def has(self, name: str) -> bool:
        return (self.folder / name).exists()


def run_record(folder: Path) -> dict[str, Any]:
    """All that the page shows of a run, as plain values.

    Raises:
        InputError: It is no folder, or nothing in it can be read.
    """
    if not folder.is_dir():
        raise InputError(f"a run folder; {RUN_MAKERS}", source=folder)
    reading = _Reading(folder)
    written = reading.fields(PLAN)
    ran = reading.has(ROLLOUT)
    plan, rollout = None, None
    if written:
        plan = reading.attempt(lambda: load_plan(folder, without=(TIMINGS,)))
        if plan is None and reading.has(SCENE):
            plan = reading.attempt(
                lambda: load_plan(folder, without=(TIMINGS, TRAJECTORY))
            )
        if ran:
            rollout = reading.attempt(lambda: load_rollout(folder))
            if rollout is None and plan is not None:
                rollout = reading.attempt(
                    lambda: load_rollout(folder, with_events=False)
                )
    elif ran:
        reading.missing.append(f"{ROLLOUT} is not shown: that takes a whole {PLAN}")
    execution = reading.fields(EXECUTION) if ran or reading.has(EXECUTION) else {}
    verdict = reading.fields(VERDICT) if ran or reading.has(VERDICT) else {}
    timings = reading.fields(TIMINGS)
    picture = reading.attempt(lambda: _picture(folder / PERSON))
    if not (written or verdict or execution or picture):
        raise InputError(
            f"a run folder with a whole {PLAN} or {VERDICT}; {RUN_MAKERS}",
            source=folder,
        )
    if written and not ran and not verdict:
        reading.missing.append(f"no {ROLLOUT}: the plan has not been run in physics")
    motion = None
    if plan is not None:
        motion = _motion(plan, rollout, execution)
    times: list[float | None] = [None] * len(written.get("keyframes", []))
    if plan is not None:
        times = keyframe_times(plan, rollout)
    name = written.get("robot", {}).get("name")
    world = None if plan is None else plan.world
    place = folder.resolve().name
    return {
        "title": f"{name}: {place}" if name else place,
        "facts": _facts(written),
        "mass": None if world is None else world.mass,
        "missing": reading.missing,
        "reached": verdict.get("reached"),
        "criteria": _criteria(verdict),
        "events": execution.get("events", []),
        "stopped": execution.get("stopped", ""),
        "fell": execution.get("fell", False),
        "adapted": rollout is not None
        and rollout.followed is not None
        and bool(rollout.events),
        "instead": written.get("instead", ""),
        "keyframes": _keyframes(written, times),
        "skipped": written.get("skipped", []),
        "options": _flat(written.get("options")),
        "versions": _flat(written.get("versions")),
        "inputs": _flat(written.get("inputs")),
        "timings": [(k, round(v, 3)) for k, v in _flat(timings.get("seconds"))],
        "picture": picture,
        "motion": motion,
    }


def _facts(written: Mapping[str, Any]) -> list[str]:
    """What the scene is, in a few words."""
    boxes = written.get("sequence", {}).get("scene", {}).get("boxes", [])
    return [
        f"{b['name']} {' x '.join(f'{x:g}' for x in b['size'])} m, friction "
        f"{b['friction']:g}"
        for b in boxes[:3]
    ]


def _criteria(verdict: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    if not verdict:
        return None
    return [{"name": n, **c} for n, c in verdict["criteria"].items()]


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


def _keyframes(
    written: Mapping[str, Any], times: list[float | None]
) -> list[dict[str, Any]]:
    """Rows of the table of stances."""
    rows, before = [], None
    for key, time in zip(written.get("keyframes", []), times, strict=True):
        stance = [
            Contact(
                surface=c["surface"],
                support=c["support"],
                position=np.array(c["position"]),
                quaternion=np.array(c["quaternion"]),
            )
            for c in key["contacts"]
        ]
        on = ", ".join(c.surface for c in stance)
        move = f"start, on {on}" if before is None else describe_move(before, stance)
        before = stance
        e = key["static_equilibrium"]
        force = _force_by_surface(e)
        rows.append(
            {
                "move": move,
                "time": time,
                "com_margin": key["com_margin"],
                "margin": e["margin"],
                "limiting": e["limiting"],
                "contacts": [
                    {
                        "surface": c["surface"],
                        "support": c["support"],
                        "position": c["position"],
                        "projected_distance": c["projected_distance"],
                        "contact_angle": c["contact_angle"],
                        "phase": c["phase"],
                        "force": force.get(c["surface"]),
                    }
                    for c in key["contacts"]
                ],
            }
        )
    return rows


def _force_by_surface(equilibrium: Mapping[str, Any]) -> dict[str, list[float]]:
    """[N] of each surface over its bearing points; empty where they are not named."""
    names, forces = equilibrium.get("surfaces"), equilibrium["forces"]
    if not isinstance(names, list) or len(names) != len(forces):
        return {}
    total: dict[str, np.ndarray] = {}
    for name, force in zip(names, forces, strict=True):
        total[str(name)] = total.get(str(name), np.zeros(3)) + np.array(force)
    return {n: f.tolist() for n, f in total.items()}


def keyframe_times(plan: Plan, rollout: Rollout | None) -> list[float | None]:
    """When each keyframe is reached [s]; None where the run never gets there.

    A plan that was adapted has times of its own: there a keyframe is looked for among
    the spells with its contacts, each after the one before, and is where the reference
    is nearest to its posture, for the last time.
    """
    if plan.trajectory is None:
        if rollout is None:  # the keyframes alone, a second each
            return [float(i) for i in range(len(plan.keyframes))]
        return [None] * len(plan.keyframes)
    followed = None if rollout is None else rollout.followed
    end = math.inf if rollout is None else float(rollout.time[-1]) + 0.02
    if followed is None:
        known = [float(t) for t in plan.trajectory.keyframes]
        known += [math.inf] * (len(plan.keyframes) - len(known))
        return [t if t <= end else None for t in known[: len(plan.keyframes)]]
    changes = np.flatnonzero(np.any(np.diff(followed.contact, axis=0), axis=1)) + 1
    spells = list(pairwise([0, *changes.tolist(), len(followed.time)]))
    times: list[float | None] = []
    first = 0
    joints = plan.world.qadr
    for key in plan.keyframes:
        wanted = {c.surface for c in key.stance}
        found = None
        for k in range(first, len(spells)):
            a, b = spells[k]
            row = followed.contact[a]
            now = {s for s, x in zip(followed.surfaces, row, strict=True) if x}
            if now == wanted and followed.time[a] <= end:
                gap = np.abs(followed.q[a:b, joints] - key.q[joints]).max(axis=1)
                near = np.flatnonzero(gap <= gap.min() + SAME_POSTURE)
                last = near[-1] if times else 0  # the run begins with the first one
                found, first = min(float(followed.time[a + last]), end), k + 1
                break
        times.append(found)
    return times


# The motion, sampled and packed.


def _motion(
    plan: Plan, rollout: Rollout | None, execution: Mapping[str, Any]
) -> dict[str, Any]:
    """What is animated and plotted of a run."""
    world = plan.world if rollout is None else rollout.world
    meshes = body_meshes(world.model)
    reference = plan.trajectory
    if rollout is not None:
        reference = rollout.followed or reference
    stills = rollout is None and reference is None
    fits = max(2, MAX_POSES // (28 * max(len(meshes), 1)))
    series: dict[str, np.ndarray | None]
    if rollout is not None:
        rows = _rows(rollout.time, fits)
        time, q = rollout.time[rows], rollout.qpos[rows]
        series = _physics(rollout, reference, rows)
    elif reference is not None:
        rows = _rows(reference.time, fits)
        time, q = reference.time[rows], reference.q[rows]
        series = {"planned": reference.contact[rows].astype(float)}
    else:
        time = np.arange(len(plan.keyframes), dtype=float)
        q = np.array([k.q for k in plan.keyframes])
        held = [{c.surface for c in k.stance} for k in plan.keyframes]
        series = {"planned": np.array([[s in h for s in world.surfaces] for h in held])}
    kin = Kinematics(world)
    q_ref = series.pop("reference", None)
    series |= _where(world, kin, q)
    planned, bears = series["planned"], series.get("loaded")
    bears = planned if bears is None else bears
    assert bears is not None
    marked = bears > 0 if planned is None else (bears > 0) | (planned > 0)
    d, limit, margin = stability_of(world, q, marked, tuple(world.surfaces))
    other = np.any(marked != (bears > 0), axis=1)  # what bears nothing holds no CoM
    margin[other] = stability_of(
        world, q[other], bears[other] > 0, tuple(world.surfaces)
    )[2]
    series["ratio"], series["margin"] = d / limit, margin
    if q_ref is not None and planned is not None:
        series["plannedMargin"] = stability_of(
            world, q_ref, planned > 0, tuple(world.surfaces)
        )[2]
        series |= _errors(world, q, q_ref)
    poses = _poses(kin, meshes, q)
    ghost = None if q_ref is None else _poses(kin, meshes, q_ref)
    keyposes = _poses(kin, meshes, np.array([k.q for k in plan.keyframes]))
    shown = [x for x in (poses, ghost, keyposes) if x is not None]
    reach = max(1e-3, *(float(np.abs(x[..., :3]).max()) for x in shown))
    for x in shown:
        x[..., :3] /= reach
    arrays = {n: None if x is None else packed(x) for n, x in series.items()}
    for name, x in (("poses", poses), ("ghost", ghost), ("keyposes", keyposes)):
        arrays[name] = None if x is None else packed(x, largest=1.0)
    end = float(time[-1])
    schedule = [] if reference is None else _spells(reference.time, reference.contact)
    loads = None
    if rollout is not None:
        loads = _spells(rollout.time, steadily_loaded(rollout))
    schedule = [[(a, min(b, end)) for a, b in x if a < end] for x in schedule]
    switches = {t for x in loads or schedule for pair in x for t in pair}
    return {
        "stills": stills,
        "times": _base64(time, "<f4"),
        "arrays": arrays,
        "meshes": [_mesh_record(m) for m in meshes],
        "edges": _box_edges(world.model),
        "seen": _seen(world, kin, q),
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
        "marginAsked": plan.options.keyframe.balance_margin,
        "schedule": schedule or [[] for _ in world.surfaces],
        "loads": loads,
        "events": sorted({round(t, 3) for t in switches if SHORTEST_LOAD < t < end}),
        "felt": [e["time"] for e in execution.get("events", []) if e["time"] <= end],
    }


def _rows(time: np.ndarray, fits: int) -> np.ndarray:
    """Indices of samples, evenly spaced, the last one among them."""
    duration = float(time[-1] - time[0])
    gaps = min(fits - 1, max(1, round(duration * SAMPLES_A_SECOND)))
    step = max(1, math.ceil((len(time) - 1) / gaps))
    return np.unique(np.append(np.arange(0, len(time), step), len(time) - 1))


def _physics(
    rollout: Rollout, reference: Trajectory | None, rows: np.ndarray
) -> dict[str, np.ndarray | None]:
    """Series of what physics made; torques and forces at their peaks."""
    world = rollout.world
    order = [world.model.actuator(name).id for name in world.joints]
    effort = rollout.actuator_force[:, order] / world.tau_max
    size = np.linalg.norm(rollout.contact_force, axis=2)
    out: dict[str, np.ndarray | None] = {
        "loaded": steadily_loaded(rollout)[rows].astype(float),
        "force": rollout.contact_force[rows],
        "size": _peaks(size, rows),
        "effort": _peaks(effort, rows),
        "planned": None,
    }
    if reference is not None:
        at = np.minimum(rows * rollout.stride, len(reference.time) - 1)
        out["planned"] = reference.contact[at].astype(float)
        out["reference"] = reference.q[at]
    if rollout.push is not None:
        at = np.minimum(rows * rollout.stride, len(rollout.push) - 1)
        size = np.linalg.norm(rollout.push, axis=1)[:, None]
        out["push"], out["pushSize"] = rollout.push[at], _peaks(size, at)
        out["base"] = rollout.qpos[rows, :3]
    return out


def _peaks(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n, k) of x (M, k), from each row up to the next: the value farthest from 0."""
    high = np.maximum.reduceat(x, rows, axis=0)
    low = np.minimum.reduceat(x, rows, axis=0)
    return np.where(high >= -low, high, low)


def _where(world: World, kin: Kinematics, q: np.ndarray) -> dict[str, np.ndarray]:
    """Lowest points (n, 3 nS) [m] of the surfaces and the supports (n, nS) below."""
    names = list(world.supports)
    points = np.zeros((len(q), len(world.surfaces), 3))
    support = np.zeros((len(q), len(world.surfaces)))
    for i, posture in enumerate(q):
        kin.update(posture)
        for j, surface in enumerate(world.surfaces):
            below = support_below(world, kin, surface)
            points[i, j] = kin.contact_point(surface, below.normal)
            support[i, j] = names.index(below.name)
    return {"points": points.reshape(len(q), -1), "support": support}


def _errors(world: World, q: np.ndarray, q_ref: np.ndarray) -> dict[str, np.ndarray]:
    """(n, 3) largest and mean square joint error [rad], distance of the base [m]."""
    off = np.abs(q[:, world.qadr] - q_ref[:, world.qadr])
    base = np.linalg.norm(q[:, :3] - q_ref[:, :3], axis=1)
    rms = np.sqrt((off**2).mean(axis=1))
    return {"error": np.stack([off.max(axis=1), rms, base], axis=1)}


def _poses(kin: Kinematics, meshes: list[Mesh], q: np.ndarray) -> np.ndarray:
    """(n, nb, 7) position [m] and unit quaternion of the drawn bodies."""
    bodies = [m.body for m in meshes]
    out = np.zeros((len(q), len(bodies), 7))
    for i, posture in enumerate(q):
        kin.update(posture)
        out[i, :, :3] = kin.data.xpos[bodies]
        out[i, :, 3:] = kin.data.xquat[bodies]
    return out


def _seen(world: World, kin: Kinematics, q: np.ndarray) -> np.ndarray:
    """(m, 3) points that a camera has to have in view [m].

    They are the corners of boxes around some postures, and the near edge.
    """
    corners = []
    sides = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    for posture in q[np.unique(np.linspace(0, len(q) - 1, 40).astype(int))]:
        kin.update(posture)
        points = robot_corners(kin)
        low, high = points.min(axis=0), points.max(axis=0)
        corners.append(low + sides * (high - low))
    return np.concatenate([*corners, near_edge_points(world.scene)]).round(3)


def steadily_loaded(rollout: Rollout) -> np.ndarray:
    """(M, nS) bool, the surfaces that bear; gaps, then touches, below 60 ms left out.

    A stiff contact that rolls is without force for a step now and then.
    """
    loaded = loaded_surfaces(rollout.world, rollout)
    last = len(rollout.time) - 1
    step = float(rollout.time[-1] - rollout.time[0]) / max(last, 1)
    for column in loaded.T:
        for state in (True, False):
            for a, b in runs_of(column != state):
                if 0 < a and b <= last and (b - a) * step < SHORTEST_LOAD:
                    column[a:b] = state
    return loaded


def _spells(time: np.ndarray, contact: np.ndarray) -> list[list[tuple[float, float]]]:
    """For each surface (columns) from when to when it is in contact [s]."""
    last = len(time) - 1
    return [
        [(float(time[a]), float(time[min(b, last)])) for a, b in runs_of(column)]
        for column in contact.T
    ]


def _box_edges(model: mujoco.MjModel) -> list[float]:
    """Ends of the edges of the boxes that stand in the world [m], 6 numbers an edge."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ends = [(a, b) for a in range(8) for b in (a | 1, a | 2, a | 4) if b > a]
    out: list[float] = []
    for g in np.flatnonzero(model.geom_bodyid == 0):
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_BOX:
            continue
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[g])
        points = corner * model.geom_size[g] @ R.reshape(3, 3).T + model.geom_pos[g]
        out += np.round(points[np.array(ends)], 5).ravel().tolist()
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

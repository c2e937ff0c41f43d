"""Every reader with damaged files: each is read, or refused in one sentence.

    python benchmarks/fuzz_readers.py [N | FROM:TO] [READER ...]

N mutated copies (1000 by default) of small good files for each reader, or for those
that are named; FROM:TO are those of other seeds. A crash, an answer after more than
5 s or a message that says nothing is told with the seed that makes it again. Counts are
printed; a run of given seeds is always the same.
"""

from __future__ import annotations

import io
import json
import pickle
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests")]

from clamber.contact.contact import PARTS  # noqa: E402
from clamber.errors import ClamberError, InputError, read_yaml  # noqa: E402
from clamber.model.terrain import load_scene  # noqa: E402
from clamber.recording.recording import load_demo, read_points  # noqa: E402
from support.bodies import body_model, body_motion, robot_motion  # noqa: E402
from support.files import (  # noqa: E402
    MOTIVE,
    box_obj,
    bvh_text,
    c3d_bytes,
    motive_csv,
    renamed,
    smpl_joints,
    trc_text,
)
from test_fuzz import mutate, short, survives  # noqa: E402

MJCF = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<geom name="a" type="box" size=".5 .5 .1" pos="1 0 .1"/></worldbody></mujoco>"""
URDF = """<robot name="t"><link name="top"><collision><origin xyz="0.8 0 0.27"/>
<geometry><box size="1.0 1.2 0.04"/></geometry></collision></link></robot>"""
SDF = """<sdf version="1.7"><world name="w"><model name="t"><static>1</static>
<pose>1 0 0.2 0 0 0.3</pose><link name="l"><collision name="c"><geometry><box>
<size>1 1 0.4</size></box></geometry></collision></link></model></world></sdf>"""
SCENE = """ground: {friction: 0.7}
boxes:
- {name: table, size: [0.9, 1.0, 0.3], position: [0.8, 0.0], rpy: [0, 0, 0.1]}
- {name: shelf, size: [0.2, 0.3, 0.1], position: [2.0, 0.0], bottom: 0.5}
start: [0.0, 0.0, 0.0]
"""
SPLIT = """o box
{v}
f 1 2 3 4
f 5 6 7 8
f 9 10 11 12
f 13 14 15 16
f 17 18 19 20
f 21 22 23 24
"""


def of(write: Callable[[io.BytesIO], object]) -> bytes:
    """What a function writes to a file."""
    out = io.BytesIO()
    write(out)
    return out.getvalue()


def split_box() -> bytes:
    """An OBJ whose faces have vertices of their own."""
    faces = ("0132", "4576", "0154", "2376", "0264", "1375")
    corner = [f"v {k & 1} {k >> 1 & 1} {k >> 2}" for k in range(8)]
    return SPLIT.format(v="\n".join(corner[int(i)] for f in faces for i in f)).encode()


@cache
def person() -> tuple[np.ndarray, list[str]]:
    """(T, F, 3) of a few samples, and the names."""
    demo = short()
    return demo.position[:12], list(demo.names)


def readers(folder: Path) -> dict[str, tuple[str, list[bytes], Callable]]:
    """By name: suffix, good files, and how they are read."""
    p, names = person()
    demo = short()
    few = replace(demo, t=demo.t[:12], position=p, valid=demo.valid[:12])
    points = partial(read_points, rate=60.0)
    whole = partial(load_demo, rate=60.0)
    model = folder / "model.npz"
    np.savez(model, **body_model(24))
    body = partial(load_demo, body_model=model)
    trc = trc_text(1000.0 * p, names, 60.0)
    c3d = [
        c3d_bytes(1000.0 * p, names, order=order, scale=scale, analog=3)
        for order in ("intel", "dec", "mips")
        for scale in (-1.0, 0.1)
    ]
    csv = motive_csv(renamed(demo, MOTIVE), p, rate=60.0)
    bvh = bvh_text(few, 100 * p, "ZXY")
    motion = body_motion(24)
    return {
        "c3d": ("c3d", c3d, points),
        "trc": ("trc", [t.encode() for t in (
            trc, trc.replace("\t", "\t\t", 6), trc.replace("\t", ","),
            trc.replace(".", ",").replace("\t", ";"))], points),
        "csv": ("csv", [csv.encode()], points),
        "bvh": ("bvh", [bvh.encode()], points),
        "npy": ("npy", [of(lambda f: np.save(f, smpl_joints(few, 22)))], points),
        "npz": ("npz", [of(lambda f: np.savez(f, positions=p, names=names, rate=60.0)),
                        of(lambda f: np.savez(f, **motion))], points),
        "demo": ("npz", [of(lambda f: np.savez(f, positions=p, names=names, rate=60))],
                 whole),
        "smpl": ("npz", [of(lambda f: np.savez(f, **motion))], body),
        "pkl": ("pkl", [pickle.dumps(motion, protocol=k) for k in (2, 4, 5)], body),
        "model": ("pkl", [pickle.dumps(body_model(24), protocol=k) for k in (2, 4)],
                  partial(_with_model, folder)),
        "robot": ("pkl", [pickle.dumps(robot_motion(), protocol=k) for k in (2, 4)],
                  partial(load_demo, robot="coman")),
        "recording": ("yaml", [recording(names)],
                      lambda path: _with_another(load_demo, path, path)),
        "obj": ("obj", [(box_obj([1, 2, 0.5], [0, 0, 0.25], 0.3, name="step")
                         + box_obj([1, 1, 1], [3, 0, 0.5], 0.0)).encode(),
                        split_box()], load_scene),
        "mjcf": ("xml", [MJCF.encode()], load_scene),
        "urdf": ("urdf", [URDF.encode()], load_scene),
        "sdf": ("sdf", [SDF.encode()], load_scene),
        "scene": ("yaml", [SCENE.encode()], load_scene),
        "yaml": ("yaml", [SCENE.encode()], read_yaml),
    }  # fmt: skip


def recording(names: list[str]) -> bytes:
    """A recording.yaml with every field."""
    parts = {n: n for n in names if n in PARTS}
    said = {
        "file": "take.npz", "rate": 60, "unit": "m", "up": "z", "max_gap": 0.1,
        "offset": [0, 0, 0.01], "rotation": [0, 0, 0.1], "span": [0.0, 0.15],
        "parts": parts, "offsets": {"Knee": 0.1},
    }  # fmt: skip
    return json.dumps(said, indent=1).encode()


def _with_model(folder: Path, path: Path) -> object:
    """A body's motion with a damaged model."""
    return _with_another(
        partial(load_demo, body_model=path), folder / "motion.npz", path
    )


def _with_another(read: Callable, first: Path, path: Path) -> object:
    """What a damaged file says of another; a refusal may name that one."""
    try:
        return read(first)
    except InputError as e:
        raise InputError(e.expected, f"{path}, {e.source}", e.field) from e


def main(words: list[str]) -> int:
    """Run; 1 where something was found."""
    numbers = [w for w in words if w.replace(":", "").isdigit()]
    first, _, last = (numbers or ["1000"])[0].rpartition(":")
    seeds = range(int(first or 0), int(last))
    wanted = [w for w in words if w not in numbers]
    found = 0
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        p, names = person()
        np.savez(folder / "take.npz", positions=p, names=names, rate=60.0)
        np.savez(folder / "motion.npz", **body_motion(24))
        for name, (suffix, files, read) in readers(folder).items():
            if wanted and name not in wanted:
                continue
            began, whole, path = time.perf_counter(), 0, folder / f"a.{suffix}"
            for k in seeds:
                seed = [k, *name.encode()]
                raw = mutate(files[k % len(files)], np.random.default_rng(seed))
                try:
                    whole += survives(read, path, raw)
                except (Exception, ClamberError) as e:  # whatever it is, it is a find
                    found += 1
                    text = " ".join(f"{type(e).__name__}: {e}".split())[:300]
                    sys.stdout.write(f"FOUND {name} seed {seed}: {text}\n")
                    if found >= 50:
                        return 1
            seconds = time.perf_counter() - began
            sys.stdout.write(
                f"{name}: {len(seeds)} files, {whole} read, "
                f"{len(seeds) - whole} refused, {seconds:.0f} s\n"
            )
            sys.stdout.flush()
    return int(found > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

"""Time and peak memory of reading 10 minutes of 60 markers at 240 Hz, by format.

Each file is made in a temporary folder and read by a process of its own, so that the
peak is that of the reader: once as named points, once as a demonstration.

    PYTHONPATH=src:tests python benchmarks/bench_read.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from clamber.recording.recording import load_demo
from support.files import c3d_bytes, from_z_up, trc_text

SECONDS, RATE, MARKERS = 600.0, 240.0, 60
FORMATS = ("c3d", "trc", "csv", "bvh", "npz")


def recording(count: int) -> tuple[list[str], np.ndarray]:
    """Names, and (T, F, 3) of the built-in climb, drawn out, with further points."""
    demo = load_demo("climb")
    names = [*demo.names, *(f"more{k}" for k in range(MARKERS - len(demo.names)))]
    t = np.linspace(demo.t[0], demo.t[-1], count)
    k = np.arange(MARKERS) % len(demo.names)
    at = np.searchsorted(demo.t, t).clip(0, len(demo.t) - 1)
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (count, MARKERS, 3))
    return names, demo.position[at][:, k] + noise


def write_csv(names: list[str], p: np.ndarray, path: Path) -> None:
    """As Motive writes markers, y up."""

    def row(lead: str, cells: list[str]) -> str:
        return ",".join([lead, *(c for c in cells for _ in range(3))]) + "\n"

    with path.open("w") as f:
        f.write(
            f"Format Version,1.23,Take Name,take,Capture Frame Rate,{RATE:.6f},"
            f"Export Frame Rate,{RATE:.6f},Rotation Type,Quaternion,"
            "Length Units,Meters,Coordinate Space,Global\n\n"
        )
        f.write(row(",Type", ["Marker"] * len(names)) + row(",Name", names))
        f.write(row(",ID", ["1"] * len(names)) + row(",", ["Position"] * len(names)))
        f.write("Frame,Time (Seconds)," + ",".join(["X,Y,Z"] * len(names)) + "\n")
        y_up = np.stack([p[..., 0], p[..., 2], -p[..., 1]], axis=-1)
        form = ",".join(["%d", "%.6f"] + ["%.6f"] * 3 * len(names)) + "\n"
        for k, values in enumerate(y_up.reshape(len(p), -1).tolist()):
            f.write(form % (k, k / RATE, *values))


def write_bvh(p: np.ndarray, path: Path) -> None:
    """A skeleton of as many joints, each turned about three axes."""
    limbs = ["UpLeg", "Leg", "Foot", "Toe"], ["Shoulder", "Arm", "ForeArm", "Hand"]
    chains = [[side + n for n in limb] for side in ("Left", "Right") for limb in limbs]
    chains.append([f"Spine{k}" for k in range(MARKERS - 1 - 16)])
    text = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 90 0\nCHANNELS 6 Xposition Yposition "
    text += "Zposition Zrotation Yrotation Xrotation\n"
    for chain in chains:
        for name in chain:
            text += f"JOINT {name}\n{{\nOFFSET 1 -40 2\nCHANNELS 3 Zrotation Yrotation "
            text += "Xrotation\n"
        text += "End Site\n{\nOFFSET 0 -5 0\n}\n" + "}\n" * len(chain)
    angles = (100.0 * p[:, :MARKERS]).reshape(len(p), -1)
    with path.open("w") as f:
        f.write(f"{text}}}\nMOTION\nFrames: {len(p)}\nFrame Time: {1 / RATE:.9f}\n")
        form = " ".join(["%.6f"] * (angles.shape[1] + 3)) + "\n"
        for values in angles.tolist():
            f.write(form % (0.0, 90.0, 0.0, *values))


def write(kind: str, path: Path) -> None:
    """One file of the kind."""
    names, p = recording(round(SECONDS * RATE))
    if kind == "csv":
        write_csv(names, p, path)
    elif kind == "bvh":
        write_bvh(p, path)
    elif kind == "npz":
        np.savez(path, positions=p.astype(np.float32), names=names, rate=RATE)
    elif kind == "c3d":
        path.write_bytes(c3d_bytes(1000.0 * p, names, rate=RATE))
    else:
        path.write_text(trc_text(1000.0 * from_z_up(p, "y"), names, RATE))


READ = """
import resource, sys, time
from clamber.recording.recording import load_demo, read_points
from pathlib import Path
call = {"points": read_points, "demo": load_demo}[sys.argv[1]]
start, cpu = time.perf_counter(), time.process_time()
call(Path(sys.argv[2]))
took = time.perf_counter() - start
cpu = time.process_time() - cpu
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(took, cpu, peak)
"""


def main(kinds: tuple[str, ...]) -> None:
    """Write, then read in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        for kind in kinds:
            path = Path(folder) / f"take.{kind}"
            if subprocess.run([sys.executable, __file__, "--write", path]).returncode:
                raise SystemExit(f"{kind} was not written")
            line = f"{kind}: {path.stat().st_size / 1e6:.0f} MB"
            for what in ("points", "demo"):
                done = subprocess.run(
                    [sys.executable, "-c", READ, what, path],
                    capture_output=True, text=True, check=True,
                )  # fmt: skip
                took, cpu, peak = map(float, done.stdout.split())
                line += (
                    f"; {what} {took:.2f} s (processor {cpu:.2f} s), peak {peak:.0f} MB"
                )
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
            path.unlink()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        target = Path(sys.argv[2])
        write(target.suffix[1:], target)
    else:
        main(tuple(sys.argv[1:]) or FORMATS)

"""Draw a recording as stick figures among its boxes, from the side and obliquely.

python examples/stick_figure.py climb figures.png
"""

from __future__ import annotations

import sys
from itertools import product

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from clamber.recording.demonstration import Demonstration
from clamber.recording.recording import load_demo

BONES = [
    *((s + a, s + b) for s in "LR" for a, b in (
        ("Shoulder", "Elbow"), ("Elbow", "Hand"), ("Hand", "Hand.tip"), ("Hip", "Knee"),
        ("Knee", "Foot"), ("Foot", "Foot.toe"),
    )),
    ("LShoulder", "RShoulder"), ("LHip", "RHip"), ("Pelvis", "Neck"), ("Neck", "Head"),
]  # fmt: skip
VIEWS = {"side": (0.0, -90.0), "oblique": (20.0, -50.0)}  # elevation, azimuth [deg]


def _draw(ax, demo: Demonstration, k: int) -> None:
    for box in demo.scene.boxes:
        corners = {
            c: box.centre + box.rotation @ (np.array(c) * box.size / 2)
            for c in product((-1, 1), repeat=3)
        }
        for a, b in product(corners, repeat=2):
            if sum(x != y for x, y in zip(a, b, strict=True)) == 1:
                ax.plot(*zip(corners[a], corners[b], strict=True), c="0.7", lw=0.6)
    for a, b in BONES:
        if a in demo.names and b in demo.names:
            ends = np.stack([demo.point(a)[k], demo.point(b)[k]], axis=1)
            colour = {"L": "tab:blue", "R": "tab:red"}.get(a[0] if b[0] == a[0] else "")
            ax.plot(*ends, c=colour or "k", lw=1.8)
    middle = demo.scene.start[:2] + np.array([0.35, 0.0])
    ax.set(xlim=middle[0] + [-0.9, 0.9], ylim=middle[1] + [-0.9, 0.9], zlim=[0, 1.8])
    ax.set_box_aspect((1, 1, 1), zoom=1.5)
    ax.set_title(f"{demo.t[k]:.1f} s", fontsize=8)
    ax.set_axis_off()


def main(
    recording: str = "climb", out: str = "stick_figures.png", n: str = "12"
) -> None:
    """Draw `n` frames of a recording into `out`."""
    demo = load_demo(recording)
    frames = np.linspace(0, len(demo.t) - 1, int(n)).astype(int)
    figure = plt.figure(figsize=(3.2 * len(frames) / 2, 13))
    for row, (elevation, azimuth) in enumerate(VIEWS.values()):
        for i, k in enumerate(frames):
            half = (len(frames) + 1) // 2
            place = (2 * row + i // half) * half + i % half + 1
            ax = figure.add_subplot(4, half, place, projection="3d", proj_type="ortho")
            _draw(ax, demo, int(k))
            ax.view_init(elevation, azimuth)
    figure.subplots_adjust(0, 0, 1, 0.98, 0, 0.03)
    figure.savefig(out, dpi=60)


if __name__ == "__main__":
    main(*sys.argv[1:])

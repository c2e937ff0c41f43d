"""Terrains to climb: ramps, rubble, gables, broken stairs, logs, tables, walls.

    python examples/terrains/make.py OUT                # 50 of them
    python examples/terrains/make.py OUT --count 10 --first 7

Each is a folder OUT/NN-kind with a mesh or a height map and its scene.yaml. The number
is the seed: the same number is the same terrain. Every other seven are scans: what is
seen from above at points 20 mm apart, with noise of up to 5 mm.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
import yaml
from scipy.spatial import ConvexHull

NOISE = 0.005  # [m] at most, of each coordinate of a scan
SPACING = 0.020  # [m] of its points
EDGE = 0.23  # [m] from the ankles to what is climbed
WIDTH = 1.2  # [m]

Rng = np.random.Generator
Solids = list[np.ndarray]  # corners (K, 3) of convex solids


def block(x: tuple[float, float], y: tuple[float, float], z: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a block on the ground.

    The heights (4,) are those of its near right, far right, far left and near left.
    """
    foot = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    top = np.column_stack([foot, z])
    return np.concatenate([np.column_stack([foot, np.zeros(4)]), top])


def side(low: float, high: float) -> tuple[float, float]:
    """From the right to the left of what is `WIDTH` wide, by shares."""
    return (low - 0.5) * WIDTH, (high - 0.5) * WIDTH


def ramp(rng: Rng) -> Solids:
    """A slope of up to 20 degrees, from an edge of 0.10 to 0.24 m."""
    slope, edge = np.tan(np.radians(rng.uniform(5, 20))), rng.uniform(0.10, 0.24)
    length = 0.7
    far = edge + slope * length
    z = np.array([edge, far, far, edge])
    return [block((EDGE, EDGE + length), side(0, 1), z)]


def rubble(rng: Rng) -> Solids:
    """Slabs of different heights, each tilted by up to five degrees."""
    height, out = rng.uniform(0.16, 0.26), []
    for i in range(3):
        for j in range(3):
            x = EDGE + 0.32 * i, EDGE + 0.32 * (i + 1)
            z = height + rng.uniform(-0.015, 0.015) + rng.uniform(-0.012, 0.012, size=4)
            out.append(block(x, side(j / 3, (j + 1) / 3), z))
    return out


def gable(rng: Rng) -> Solids:
    """A roof: it falls to both sides by 5 to 12 degrees from a ridge along the way."""
    fall = np.tan(np.radians(rng.uniform(5, 12))) * WIDTH / 2
    ridge = rng.uniform(0.24, 0.30)
    x = EDGE, EDGE + 0.9
    return [
        block(x, side(0, 0.5), ridge - fall * np.array([1, 1, 0, 0])),
        block(x, side(0.5, 1), ridge - fall * np.array([0, 0, 1, 1])),
    ]


def stairs(rng: Rng) -> Solids:
    """Two or three steps, none like the other, with a piece broken out of an edge."""
    x, z, out = EDGE, 0.0, []
    count = int(rng.integers(2, 4))
    for i in range(count):
        z += rng.uniform(0.07, 0.13)
        depth = 0.7 if i == count - 1 else rng.uniform(0.24, 0.34)
        heights = z + rng.uniform(-0.006, 0.006, size=4)
        gone = rng.uniform(0.03, 0.08)
        out.append(block((x + gone, x + depth), side(0, 0.3), heights))
        out.append(block((x, x + depth), side(0.3, 1), heights))
        x += depth
    return out


def logs(rng: Rng) -> Solids:
    """Trunks side by side, flattened on top, along the edge."""
    height, out, x = rng.uniform(0.15, 0.24), [], EDGE
    while x < EDGE + 0.8:
        r = rng.uniform(0.10, 0.14)
        angle = np.linspace(0.0, 2.0 * np.pi, 28, endpoint=False)
        ring = np.column_stack([x + r + r * np.cos(angle), 0.35 * r * np.sin(angle)])
        z = np.maximum(height - 0.35 * r + ring[:, 1], 0.0)
        ring[:, 1] = z
        foot = np.column_stack([ring[:, 0], np.zeros(len(ring))])
        both = np.concatenate([ring, foot])
        out.append(
            np.concatenate(
                [
                    np.column_stack([both[:, 0], np.full(len(both), y), both[:, 1]])
                    for y in side(0, 1)
                ]
            )
        )
        x += 2.0 * r
    return out


def table(rng: Rng) -> Solids:
    """A thin top on four legs."""
    height, thick = rng.uniform(0.18, 0.30), 0.04
    x = EDGE, EDGE + 0.9
    top = block(x, side(0, 1), np.full(4, height))
    top[:4, 2] = height - thick
    out = [top]
    for lx in (x[0] + 0.1, x[1] - 0.15):
        for ly in (0.05, 0.89):
            leg = block(
                (lx, lx + 0.06), side(ly, ly + 0.05), np.full(4, height - thick)
            )
            out.append(leg)
    return out


def walls(rng: Rng) -> Solids:
    """A block between two walls that are twice as high."""
    height, room = rng.uniform(0.16, 0.28), rng.uniform(0.9, 1.1)
    x, half = (EDGE, EDGE + 0.9), 0.5 * room
    out = [block(x, (-half, half), np.full(4, height))]
    for y in ((-half - 0.1, -half), (half, half + 0.1)):
        out.append(block(x, y, np.full(4, 2.0 * height)))
    return out


KINDS: tuple[Callable[[Rng], Solids], ...] = (
    ramp,
    rubble,
    gable,
    stairs,
    logs,
    table,
    walls,
)
SUFFIXES = (".obj", ".stl", ".ply", ".glb")


def seen(solids: Solids) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights (rows, columns) of solids from above, at x (columns,) and y (rows,)."""
    corners = np.concatenate(solids)
    low, high = corners.min(axis=0) - SPACING, corners.max(axis=0) + SPACING
    x, y = (np.arange(low[k], high[k] + SPACING / 2, SPACING) for k in (0, 1))
    X, Y = np.meshgrid(x, y)
    heights = np.zeros(X.shape)
    for s in solids:
        planes = ConvexHull(s).equations  # n p + d <= 0 inside
        upper = planes[planes[:, 2] > 1e-9]
        n, d = upper[:, :3], upper[:, 3]
        z = -(np.multiply.outer(X, n[:, 0]) + np.multiply.outer(Y, n[:, 1]) + d)
        z = (z / n[:, 2]).min(axis=-1)
        points = np.stack([X, Y, z], axis=-1)
        inside = (points @ planes[:, :3].T + planes[:, 3] <= 1e-6).all(axis=-1)
        heights = np.where(inside, np.maximum(heights, z), heights)
    return x, y, heights


def surface(x: np.ndarray, y: np.ndarray, heights: np.ndarray) -> trimesh.Trimesh:
    """The triangles of heights."""
    X, Y = np.meshgrid(x, y)
    i = np.arange(X.size).reshape(X.shape)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    halves = (a, b, d), (a, d, c)
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in halves])
    vertices = np.stack([X, Y, heights], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)


def write_terrain(number: int, out: Path) -> Path:
    """A terrain by its number; returns its scene.yaml."""
    rng = np.random.default_rng(number)
    kind = KINDS[number % len(KINDS)]
    solids = kind(rng)
    name = kind.__name__
    folder = out / f"{number:02d}-{name}"
    folder.mkdir(parents=True, exist_ok=True)
    entry: dict[str, object] = {"name": name, "friction": 0.8}
    scene: dict[str, object] = {"ground": {"friction": 0.8}}
    mesh = trimesh.util.concatenate([trimesh.convex.convex_hull(s) for s in solids])
    scanned = (number // len(KINDS)) % 2 == 1
    if scanned:
        x, y, heights = seen(solids)
        mesh = surface(x, y, heights)
        noise = rng.uniform(-NOISE, NOISE, size=mesh.vertices.shape)
        mesh.vertices = mesh.vertices + noise
    if scanned and number % 2:
        z = heights + noise[:, 2].reshape(heights.shape)
        np.save(folder / f"{name}.npy", z)
        size = [round(float(np.ptp(v)), 6) for v in (x, y)]
        middle = [round(float((v[0] + v[-1]) / 2), 6) for v in (x, y)]
        entry |= {"file": f"{name}.npy", "size": size, "position": middle}
        scene["heightfields"] = [entry]
    else:
        suffix = SUFFIXES[number % len(SUFFIXES)]
        if suffix in (".stl", ".obj"):  # as drawing programs write them
            mesh.apply_scale(1000.0)
            entry["unit"] = "mm"
        if suffix == ".glb":
            v = mesh.vertices
            mesh.vertices = np.column_stack([v[:, 0], v[:, 2], -v[:, 1]])
            entry["up"] = "y"
        mesh.export(folder / f"{name}{suffix}")
        entry["file"] = f"{name}{suffix}"
        scene["meshes"] = [entry]
    scene |= {"start": [0.0, 0.0, 0.0], "goal": [round(EDGE + 0.05, 3), 0.0]}
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene, sort_keys=False))
    return folder / "scene.yaml"


def main() -> None:
    """Write terrains."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    for number in range(args.first, args.first + args.count):
        print(write_terrain(number, args.out))


if __name__ == "__main__":
    main()

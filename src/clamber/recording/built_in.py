"""The two built-in demonstrations, which are synthetic and labelled so.

No recording of such motions is free to ship, so a program made these (`tests/support`
holds it, and the contacts that are true). A file has the motion without noise, as whole
numbers of 2^-bits metres of which differences are taken over and over, as these are
small, and then compressed. Noise of a given seed is added here and stretches that no
camera saw are cut out: noise does not compress.

`bits` is 58: a position is then the generator's own to the last bit that counts beside
the noise, and so is whatever is planned from it.
"""

from __future__ import annotations

import lzma
from pathlib import Path

import numpy as np

from clamber.model.scene import Box, Scene
from clamber.recording.demonstration import (
    Demonstration,
    RawTracks,
    build_demonstration,
)

_DATA = Path(__file__).parent / "data"
BUILT_IN = ("climb", "crossing")


def source_of(name: str) -> str:
    """The `source` of one of `BUILT_IN`, without its motion."""
    with np.load(_DATA / f"{name}.npz", allow_pickle=False) as z:
        return str(z["source"])


def load_built_in(name: str) -> Demonstration:
    """One of `BUILT_IN`.

    In the file, of T samples and F points: `source`, `names` (F,), `rate` [Hz]; `box`
    with size, position [m] and its `box_name`; `noise` [m], `seed`, and `drawn`, how
    many numbers were drawn from it before the noise; `gaps` (G, 3) of first sample,
    samples and point; `motion`, the compressed bytes of the differences (8, F * 3, T),
    the lowest byte first, `order` and `bits`.
    """
    with np.load(_DATA / f"{name}.npz", allow_pickle=False) as z:
        names, size, position = z["names"].tolist(), *z["box"]
        packed = np.frombuffer(lzma.decompress(z["motion"].tobytes()), dtype=np.uint8)
        planes = packed.reshape(8, 3 * len(names), -1)
        whole = np.ascontiguousarray(planes.transpose(2, 1, 0)).view("<i8")
        for _ in range(int(z["order"])):
            whole = np.cumsum(whole, axis=0)  # wraps around where they did
        raw = whole.reshape(-1, len(names), 3) * 2.0 ** -int(z["bits"])
        bits = np.random.PCG64(int(z["seed"])).advance(int(z["drawn"]))
        raw += float(z["noise"]) * np.random.Generator(bits).standard_normal(raw.shape)
        for first, count, point in z["gaps"]:
            raw[first : first + count, point] = np.nan
        box = Box(
            name=str(z["box_name"]), size=size, centre=position, rotation=np.eye(3)
        )
        return build_demonstration(
            RawTracks(
                source=source_of(name),
                synthetic=True,
                names=tuple(names),
                position=raw,
                rate=float(z["rate"]),
                scene=Scene(boxes=(box,), start=np.zeros(3)),
            )
        )

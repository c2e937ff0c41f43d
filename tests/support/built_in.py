"""The files of the built-in demonstrations, from the programs that make them.

    PYTHONPATH=src:tests python -m support.built_in

writes src/clamber/recording/data anew. `clamber.recording.built_in` says what is in a
file and reads it.
"""

from __future__ import annotations

import lzma
from pathlib import Path

import numpy as np

from clamber.recording import built_in
from support import climb, crossing
from support.figure import SWAYS, draw_gaps

SEED = 20  # the same demonstrations everywhere, always
BITS = {"climb": 58, "crossing": 58}  # of a metre's fraction, below 64
ORDER = 8  # of the differences: the file is smallest so
MADE = {
    "climb": (climb.synthesize_climb, climb.clean_motion, climb.ClimbOptions()),
    "crossing": (
        crossing.synthesize_crossing,
        crossing.clean_motion,
        crossing.CrossingOptions(),
    ),
}


def packed(name: str, bits: int) -> dict[str, object]:
    """What the file of a demonstration has, at 2^-bits metres."""
    synthesize, clean_motion, options = MADE[name]
    demo, _ = synthesize(np.random.default_rng(SEED), options=options)
    rng = np.random.default_rng(SEED)
    tracks, _ = clean_motion(rng, options)
    motion = np.stack(list(tracks.values()), axis=1)
    rng.standard_normal(motion.shape)  # the noise comes before the gaps
    whole = np.round(motion.reshape(len(motion), -1) * 2.0**bits).astype("<i8")
    for _ in range(ORDER):
        whole[1:] -= whole[:-1].copy()
    planes = whole.view(np.uint8).reshape(*whole.shape, 8).transpose(2, 1, 0)
    box = demo.scene.boxes[0]
    return {
        "source": demo.source,
        "names": list(tracks),
        "rate": options.rate,
        "box": np.stack([box.size, box.centre]),
        "box_name": box.name,
        "noise": options.noise,
        "seed": SEED,
        "drawn": SWAYS,
        "gaps": np.array(draw_gaps(rng, options.gaps, options.rate, motion.shape)),
        "motion": np.frombuffer(lzma.compress(planes.tobytes(), preset=9), np.uint8),
        "order": ORDER,
        "bits": bits,
    }


if __name__ == "__main__":
    for name, bits in BITS.items():
        file = Path(built_in.__file__).parent / "data" / f"{name}.npz"
        np.savez(file, **packed(name, bits))

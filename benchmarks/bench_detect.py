"""Time of contact detection on 25 s at 120 Hz; prints the median in seconds."""

from __future__ import annotations

import statistics
import sys
import time

import numpy as np

from clamber.recording.detect import detect_contacts
from clamber.recording.synthetic import ClimbOptions, synthesize_climb

DURATION = 25.0  # [s] of the recording
USUAL = 21.5  # [s] of the built-in climb at its usual speed


def main(repeats: int = 9) -> None:
    """Detect a few times after one warm-up."""
    options = ClimbOptions(speed=USUAL / DURATION)
    demo, _ = synthesize_climb(np.random.default_rng(0), options=options)
    detect_contacts(demo)
    took = []
    for _ in range(repeats):
        start = time.perf_counter()
        detect_contacts(demo)
        took.append(time.perf_counter() - start)
    sys.stdout.write(
        f"detect_contacts, {demo.t[-1]:.1f} s of {len(demo.names)} points at "
        f"{demo.rate:.0f} Hz: {statistics.median(took):.4f} s\n"
    )


if __name__ == "__main__":
    main()

"""Time of contact detection on the built-in climb; prints the median in seconds."""

from __future__ import annotations

import statistics
import sys
import time

from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo


def main(repeats: int = 9) -> None:
    """Detect a few times after one warm-up."""
    demo = load_demo("climb")
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

"""Time of a contact change and of a whole plan, and memory over many plans.

    python benchmarks/bench_plan.py

COMAN climbs boxes of 0.275 and 0.56 m after the built-in recording, and crosses a table
of 1 m with the policy of the other. A contact change is one call of `change_contact`:
keyframe, transition and path, or why there is none. A plan is all of those that its
search tries, and the trajectory; detection, loading and writing files are not counted.
CPU time, warm, in a single thread: where a search fails at first, several take less of
the clock. First, the lower box is planned again and again: memory should not grow.
"""

from __future__ import annotations

import contextlib
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from unittest import mock

import numpy as np

from clamber.contact.learn import learn_policy
from clamber.model.robot import load_robot
from clamber.model.scene import Box, Scene
from clamber.planning import search
from clamber.planning.planner import plan
from clamber.planning.records import Plan
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo

REPEATS = 5
PLANS = 100  # memory is looked at after a tenth of them, and after all
TABLE = 1.0  # [m] its length


def peak_memory() -> float:
    """Of this process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e6


def climb(height: float) -> Callable[[], Plan]:
    sequence, robot = detect_contacts(load_demo("climb")), load_robot("coman")
    return lambda: plan(sequence, robot, Scene.from_height(height))


def crossing() -> Callable[[], Plan]:
    policy = learn_policy([detect_contacts(load_demo("crossing"))])
    robot = load_robot("coman")
    box = Box(
        name="table",
        size=np.array([TABLE, 0.8, 0.27]),
        centre=np.array([0.23 + TABLE / 2, 0.0, 0.135]),
        rotation=np.eye(3),
    )
    goal = np.array([TABLE + 0.68, 0.0])
    scene = Scene(boxes=(box,), start=np.zeros(3), goal=goal)
    return lambda: plan(policy, robot, scene)


@contextlib.contextmanager
def timed_changes() -> Iterator[list[float]]:
    """CPU time of each contact change that is tried meanwhile [ms]."""
    changes: list[float] = []
    change_contact = search.change_contact

    def change(*args):
        start = time.thread_time()
        found = change_contact(*args)
        changes.append(1e3 * (time.thread_time() - start))
        return found

    with mock.patch.object(search, "change_contact", change):
        yield changes


def timed(job: Callable[[], Plan]) -> tuple[Plan, list[float], list[float]]:
    """A plan; contact changes and plans, all of them repeated [ms]."""
    plans: list[float] = []
    made = job()
    with timed_changes() as changes:
        for _ in range(REPEATS):
            start = time.thread_time()
            made = job()
            plans.append(1e3 * (time.thread_time() - start))
    return made, changes, plans


def main() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    low = climb(0.275)
    for k in range(PLANS):
        low()
        if k + 1 in (PLANS // 10, PLANS):
            print(f"peak memory after {k + 1:3d} plans: {peak_memory():.1f} MB")
    print(f"{'':24}{'contact changes [ms]':>38}{'plan [ms]':>18}")
    print(
        f"{'':24}{'made':>6}{'tried':>8}{'median':>8}{'99 %':>8}{'most':>8}"
        f"{'median':>9}{'changes':>9}"
    )
    for name, job in (
        ("climb onto 0.275 m", low),
        ("climb onto 0.56 m", climb(0.56)),
        (f"across a table of {TABLE:g} m", crossing()),
    ):
        made, changes, plans = timed(job)
        median, high = np.percentile(changes, [50, 99])
        print(
            f"{name:24}{len(made.changes):6d}{len(changes) // REPEATS:8d}{median:8.2f}"
            f"{high:8.2f}{max(changes):8.2f}{np.median(plans):9.0f}"
            f"{sum(changes) / REPEATS:9.0f}{'' if made.complete else '   INCOMPLETE'}"
        )


if __name__ == "__main__":
    main()

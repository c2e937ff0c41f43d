"""How much faster than real time physics runs, controller and recording included.

    python benchmarks/bench_simulation.py

Simulates the built-in climb a few times by either controller, and steps the recorded
commands in plain MuJoCo for comparison: the difference is what controller and
measurements cost. Times are those of the processor, so that other programs do not
count.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time

import mujoco
import numpy as np

from clamber.execution.servo import ControlMode
from clamber.execution.simulation import simulate
from clamber.execution.verdict import judge
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import PHYSICS_STEP
from clamber.planning.planner import plan
from clamber.planning.records import Plan
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo

HEIGHT = 0.275  # [m]
REPEATS = 5


def peak_memory() -> float:
    """Of this process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def replay(xml: str, start: np.ndarray, ctrl: np.ndarray) -> float:
    """Seconds that plain MuJoCo takes for the recorded commands."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    began = time.process_time()
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    return time.process_time() - began


def main() -> None:
    sequence, robot = detect_contacts(load_demo("climb")), load_robot("coman")
    result = plan(sequence, robot, Scene.from_height(HEIGHT))
    before = peak_memory()
    for controller in ("mixed", "pid"):
        compare(result, controller)
    print(f"peak memory {peak_memory():.0f} MB, {before:.0f} MB of it before physics")


def compare(plan: Plan, controller: ControlMode) -> None:
    ours, plain, judging, ratios = [], [], [], []
    for _ in range(REPEATS):
        start = time.process_time()
        rollout = simulate(plan, controller=controller)
        ours.append(time.process_time() - start)
        start = time.process_time()
        verdict = judge(plan, rollout)
        judging.append(time.process_time() - start)
        plain.append(replay(rollout.world.xml, rollout.qpos[0], rollout.ctrl))
        ratios.append(ours[-1] / plain[-1])
    seconds = len(rollout.ctrl) * PHYSICS_STEP
    print(
        f"climb onto {HEIGHT} m, {controller}, {seconds:.0f} s of motion at 1 kHz,"
        f" {'reached' if verdict.reached else 'NOT REACHED'}; median of {REPEATS}"
    )
    print(f"{'':14}{'[s]':>8}{'x real time':>14}{'us a step':>12}")
    for name, took in (("simulate", ours), ("plain MuJoCo", plain)):
        t = statistics.median(took)
        per_step = 1e6 * t / len(rollout.ctrl)
        print(f"{name:14}{t:8.2f}{seconds / t:14.1f}{per_step:12.1f}")
    print(f"{'judge':14}{statistics.median(judging):8.4f}")
    print(
        f"simulate takes {statistics.median(ratios):.2f} times what plain MuJoCo does,"
        f" of the processor ({min(ratios):.2f} to {max(ratios):.2f})"
    )


if __name__ == "__main__":
    main()

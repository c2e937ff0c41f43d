"""What tests share: a seeded generator, finite differences, a toy world, recordings."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clamber.model.scene import Box, Scene

ROOT = Path(__file__).parents[1]

# A cart on a rail with a swinging, weighted arm over a box: two joints, three geoms.
TOY = """
<mujoco model="toy">
  <worldbody>
    <geom name="ground" type="plane" size="0 0 0.05"/>
    <geom name="box" type="box" size="0.2 0.2 0.1" pos="0.6 0 0.1"/>
    <body name="cart" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom name="cart" type="box" size="0.1 0.1 0.05" mass="2"/>
      <body name="arm" pos="0.1 0 0">
        <joint name="swing" type="hinge" axis="0 1 0" range="-2 2" limited="true"/>
        <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def stairs(steps: int, rise: float, tread: float) -> Scene:
    """One behind the other; the goal is the middle of the last."""
    boxes = tuple(
        Box(
            name=f"s{i + 1}",
            size=np.array([tread, 0.8, rise * (i + 1)]),
            centre=np.array([0.23 + tread * (i + 0.5), 0.0, rise * (i + 1) / 2]),
            rotation=np.eye(3),
        )
        for i in range(steps)
    )
    goal = np.array([0.23 + tread * (steps - 0.5), 0.0])
    return Scene(boxes=boxes, start=np.zeros(3), goal=goal)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)


@pytest.fixture
def toy_mjcf() -> str:
    return TOY


@pytest.fixture
def finite_difference() -> Callable[..., np.ndarray]:
    """`finite_difference(f, x)`: central differences, a column per entry of x."""

    def difference(f, x, step: float = 1e-6) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        columns = []
        for e in np.eye(x.size) * step:
            columns.append((np.asarray(f(x + e)) - np.asarray(f(x - e))) / (2 * step))
        return np.stack(columns, axis=-1)

    return difference


@pytest.fixture(scope="session")
def shared() -> Path:
    """Recordings beside a checkout, which the repository does not carry."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("no folder of recordings beside the repository")
    return folder


# What takes seconds to make: `make fast` leaves out who asks for it.
WHOLE = {
    *("demo_plan", "fast_plan", "hands_plan", "demo_rollout", "demo_kinematics"),
    *("one_hand_plan", "one_hand_rollout"),
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they ask for: a whole plan or run, a browser."""
    for item in items:
        names = set(getattr(item, "fixturenames", ()))
        if names & WHOLE:
            item.add_marker("whole")
        if "browser" in names:
            item.add_marker("browser")


# The demonstration planned and simulated once for all tests that look at the result.
DEMO_HEIGHT = 0.275  # [m] the box of the method's own experiments


@pytest.fixture(scope="session")
def coman():
    from clamber.model.robot import load_robot

    return load_robot("coman")


@pytest.fixture(scope="session")
def demo_sequence():
    """What is detected in the built-in climb, at the person's scale."""
    from clamber.recording.detect import detect_contacts
    from clamber.recording.recording import load_demo

    return detect_contacts(load_demo("climb"))


@pytest.fixture(scope="session")
def demo_plan(demo_sequence, coman):
    from clamber.model.scene import Scene
    from clamber.planning.planner import plan

    return plan(demo_sequence, coman, Scene.from_height(DEMO_HEIGHT))


@pytest.fixture(scope="session")
def fast_plan(demo_plan):
    """The same postures, as fast as joints and contacts bear."""
    from dataclasses import replace

    from clamber.planning.trajectory import timed
    from clamber.step.ik import IK

    trajectory = timed(IK(demo_plan.world), demo_plan.changes, "max")
    options = replace(demo_plan.options, speed="max")
    return replace(demo_plan, options=options, trajectory=trajectory)


@pytest.fixture(scope="session")
def hands_plan(demo_plan):
    """Fast, and no more than the first two steps: both hands on the box."""
    from dataclasses import replace

    from clamber.planning.trajectory import timed
    from clamber.step.ik import IK

    changes, stances = demo_plan.changes[:2], demo_plan.sequence.stances
    down = [
        i
        for i, stance in enumerate(stances)
        if {"LHand", "RHand"} <= set(stance.surfaces)
    ]
    trajectory = timed(IK(demo_plan.world), changes, "max")
    return replace(
        demo_plan,
        options=replace(demo_plan.options, speed="max"),
        sequence=replace(
            demo_plan.sequence,
            stances=stances[: down[0] + 1],
            t=demo_plan.sequence.t[: down[0] + 2],
        ),
        changes=changes,
        trajectory=trajectory,
    )


@pytest.fixture(scope="session")
def demo_paths(demo_plan):
    """What the contact changes were made of: their transitions and paths."""
    from clamber.step.ik import IK
    from clamber.step.path import plan_path
    from clamber.step.transition import plan_shift, plan_transition

    ik, keys, out = IK(demo_plan.world), demo_plan.keyframes, []
    for before, after, change in zip(keys, keys[1:], demo_plan.changes, strict=False):
        held = change.phases[1].contacts
        shift = plan_shift(ik, before, change.step, held, margin=change.margin)
        out.append(plan_path(ik, plan_transition(ik, shift, after, change.step)))
    return out


@pytest.fixture(scope="session")
def demo_rollout(demo_plan):
    """Open loop, by sensors that know everything."""
    from clamber.execution.disturbance import Disturbance
    from clamber.execution.simulation import simulate

    exact = Disturbance(noise=0.0, delay=0.0)
    return simulate(demo_plan, controller="pid", disturbance=exact)


@pytest.fixture(scope="session")
def demo_kinematics(demo_plan):
    """A workspace of the planned world: every test updates it before it looks."""
    from clamber.model.kinematics import Kinematics

    return Kinematics(demo_plan.world)


# The shortest motion there is, for tests of what is made of a run.


def contact(surface: str, support: str, x: float, y: float, z: float):
    """A contact that lies level and faces x."""
    from clamber.contact.contact import Contact

    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, y, z]),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
    )


@pytest.fixture(scope="session")
def one_hand():
    """Standing, then the left hand on a box."""
    from clamber.contact.contact import ContactSequence, Stance
    from clamber.model.scene import Scene

    feet = (
        contact("LFoot", "ground", 0.03, 0.07, 0.0),
        contact("RFoot", "ground", 0.03, -0.07, 0.0),
    )
    both = (*feet, contact("LHand", "box", 0.43, 0.17, 0.25))
    return ContactSequence(
        source="made up",
        subject=None,
        scene=Scene.from_height(0.25),
        stances=(Stance(contacts=feet), Stance(contacts=both)),
        t=np.array([0.0, 1.0, 2.0]),
    )


@pytest.fixture(scope="session")
def one_hand_plan(one_hand, coman):
    """That, planned at 1 rad/s."""
    from clamber.planning.planner import plan
    from clamber.planning.records import PlanOptions

    return plan(one_hand, coman, one_hand.scene, options=PlanOptions(speed=1.0))


@pytest.fixture(scope="session")
def one_hand_rollout(one_hand_plan):
    """And followed open loop."""
    from clamber.execution.simulation import simulate

    return simulate(one_hand_plan, controller="pid")


@pytest.fixture(scope="session")
def plan(one_hand_plan):
    """For short, where one plan is as good as another."""
    return one_hand_plan


@pytest.fixture(scope="session")
def rollout(one_hand_rollout):
    """Of that plan."""
    return one_hand_rollout


@pytest.fixture(scope="module")
def whole(one_hand_plan, one_hand_rollout, tmp_path_factory) -> Path:
    """The run folder of that motion; of the module alone, which may write in it."""
    from clamber import judge
    from clamber.run.folder import save_plan, save_rollout, save_verdict

    folder = tmp_path_factory.mktemp("whole")
    save_plan(one_hand_plan, folder)
    save_rollout(one_hand_plan, one_hand_rollout, folder)
    save_verdict(judge(one_hand_plan, one_hand_rollout), folder)
    return folder


@pytest.fixture(scope="module")
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Headless Chromium with a software renderer; a module may name its flags."""
    drawn = ["--use-gl=angle", "--use-angle=swiftshader"]  # all of it, as by a card
    chromium = shutil.which("chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    if chromium is None:
        pytest.skip("no chromium here")
    with playwright.sync_playwright() as p:
        made = p.chromium.launch(
            executable_path=chromium,
            args=[
                "--no-sandbox",
                "--enable-unsafe-swiftshader",
                *getattr(request.module, "BROWSER_FLAGS", drawn),
            ],
        )
        yield made
        made.close()

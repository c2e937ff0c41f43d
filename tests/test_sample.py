"""What there is to see of a run: the same series for plots, tables and 3D."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.planning.records import Plan
from clamber.recording.demonstration import runs
from clamber.show import sample

# Series.


def test_the_figures_at_the_end_are_those_of_the_last_keyframe(
    plan: Plan, rollout: Rollout
):
    motion = sample.sample_motion(plan, rollout, {}, 10)
    assert motion.loaded is not None
    key, names = plan.keyframes[-1], list(plan.world.surfaces)
    loaded = {s for s, x in zip(names, motion.loaded[-1], strict=True) if x}
    assert loaded == {c.contact.surface for c in key.contacts}
    for c in key.contacts:
        j = names.index(c.contact.surface)
        d, limit = motion.distance[-1, j], motion.limit[-1, j]
        assert d == pytest.approx(c.projected_distance, abs=0.015)
        assert (d <= limit) == (c.phase == "supporting")
    assert motion.margin[-1] == pytest.approx(key.com_margin, abs=0.015)


def test_nothing_loaded_has_no_margin(plan: Plan, rollout: Rollout):
    flying = replace(rollout, contact_force=np.zeros_like(rollout.contact_force))
    motion = sample.sample_motion(plan, flying, {}, 5)
    assert np.isnan(motion.margin).all()
    assert motion.loads == [[] for _ in plan.world.surfaces]


def test_a_surface_stands_on_the_support_below_it(plan: Plan, rollout: Rollout):
    kin = Kinematics(plan.world)
    kin.update(rollout.qpos[-1])
    assert sample.support_below(plan.world, kin, "LHand").name == "box"
    assert sample.support_below(plan.world, kin, "RFoot").name == "ground"


def test_no_peak_is_lost_between_samples(rng: np.random.Generator):
    x = rng.normal(size=(100, 3))
    rows = np.array([0, 7, 30, 99])
    peaks = sample.peaks(x, rows)
    for i, (a, b) in enumerate([(0, 7), (7, 30), (30, 99), (99, 100)]):
        for j in range(3):
            part = x[a:b, j]
            assert peaks[i, j] == part[np.abs(part).argmax()]


def test_rows_are_even_keep_the_end_and_fit():
    t = np.arange(1001) * 0.01
    rows = sample.even_rows(t, 10_000)
    assert rows[0] == 0
    assert rows[-1] == 1000
    assert len(rows) == 251
    assert len(sample.even_rows(t, 20)) <= 21
    assert sample.even_rows(t[:1], 20).tolist() == [0]


def test_short_gaps_and_touches_are_none(rollout: Rollout):
    force = np.zeros_like(rollout.contact_force)
    force[10:60, 0, 2] = 100.0
    force[30:34, 0, 2] = 0.0  # 40 ms without
    force[20:40, 1, 2] = 100.0
    force[50:53, 1, 2] = 100.0  # 30 ms with
    force[70:80, 2, 2] = 100.0
    force[90:99, 2, 2] = 100.0  # after 100 ms
    force[2:9, 3, 2] = 100.0  # all but from the beginning
    force[0:3, 4, 2] = 100.0  # no longer than that
    force[8:20, 5, 2] = 100.0  # later
    steady = sample.steadily_loaded(replace(rollout, contact_force=force))
    spans = [runs(column) for column in steady.T]
    assert spans[:3] == [[(10, 60)], [(20, 40)], [(70, 80), (90, 99)]]
    assert spans[3:6] == [[(0, 9)], [(0, 3)], [(8, 20)]]
    assert not any(spans[6:])


# When keyframes are reached.


def test_keyframes_are_reached_when_the_plan_says(plan: Plan, rollout: Rollout):
    assert plan.trajectory is not None
    assert sample.keyframe_times(plan, rollout) == plan.trajectory.keyframes.tolist()
    early = replace(rollout, time=rollout.time * 0.5)
    assert sample.keyframe_times(plan, early) == [0.0, None]
    bare = replace(plan, trajectory=None)
    assert sample.keyframe_times(bare, None) == [0.0, 1.0]


def test_a_change_is_under_way_until_its_keyframe_is_reached():
    names, reached = ["one", "two"], [0.0, 1.0, 2.0]
    at = [sample.change_at(names, reached, t) for t in (0.0, 0.9, 1.0, 1.9, 2.0)]
    assert at == ["one", "one", "two", "two", "done"]
    assert sample.change_at(names, [0.0, 1.0, None], 9.0) == "two"


def test_keyframes_of_an_adapted_run_are_reached_when_it_says(
    plan: Plan, rollout: Rollout
):
    t = plan.trajectory
    assert t is not None
    later = replace(rollout, followed=replace(t, keyframes=np.array([0.0, 3.5])))
    assert sample.keyframe_times(plan, later) == [0.0, 3.5]
    never = replace(rollout, followed=replace(t, keyframes=np.zeros(1)))
    assert sample.keyframe_times(plan, never) == [0.0, None]

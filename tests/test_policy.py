"""Records of a policy, the pelvis's angles, and where which distribution holds."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from clamber.contact.contact import Contact, Stance
from clamber.contact.policy import (
    IMPOSED,
    DemoPolicy,
    Edge,
    GeneralPolicy,
    Option,
    PelvisDistribution,
    climbed_edges,
    pelvis_angles,
    pelvis_distribution,
    pelvis_rotation,
)
from clamber.errors import InputError
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy, wrap
from clamber.run.folder import load_policy, policy_summary, save_policy


def table(yaw: float = 0.0, centre=(1.0, 0.0)) -> Box:
    return Box(
        name="table",
        size=np.array([1.6, 0.9, 0.6]),
        centre=np.array([*centre, 0.3]),
        rotation=matrix_from_rpy([0.0, 0.0, yaw]),
    )


def contact(surface: str, support: str = "ground", x: float = 0.0) -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, 0.0, 0.6 if support == "table" else 0.0]),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
    )


FEET = (contact("LFoot"), contact("RFoot"))
POSE = np.array([0.1, 0.0, 0.9, 1.0, 0.0, 0.0, 0.0])


def option(**fields) -> Option:
    values = {
        "name": "ac1", "region": "M", "surfaces": ("LHand", "RHand"), "repeats": 2,
        "initiation": ("G", "M"), "held": ("LFoot", "RFoot"), "termination": "goal",
    }  # fmt: skip
    return Option(**(values | fields))


def pelvis(
    mean=(0.0, 1.2, 0.1), sigma=(0.1, 0.2, 1.0), samples=9
) -> PelvisDistribution:
    return PelvisDistribution(
        mean=np.array(mean), sigma=np.array(sigma), samples=samples
    )


def demo(**fields) -> DemoPolicy:
    hands = (*FEET, contact("LHand", "table", 0.5))
    states = (
        Stance(contacts=FEET, pelvis=POSE),
        Stance(contacts=hands, posture={"trunk": np.array([1.0, 0.0, 0.0])}),
        Stance(contacts=FEET, pelvis=POSE),
    )
    values = {
        "source": "by hand", "scene": Scene(boxes=(table(),), start=np.zeros(3)),
        "subject": {"thigh": 0.37}, "states": states, "actions": ("LHand", None),
    }  # fmt: skip
    return DemoPolicy(**(values | fields))


def policy(**fields) -> GeneralPolicy:
    values = {
        "options": (option(),), "over_top": pelvis(), "near_edge": pelvis((0, 1, 0)),
        "goal": ("LFoot", "RFoot"), "reach": {"LHand": 0.3}, "demos": (demo(),),
        "notes": ("a note",),
    }  # fmt: skip
    return GeneralPolicy(**(values | fields))


# Angles.


def test_angles_and_rotation_are_inverse_past_the_horizontal_too(rng):
    for _ in range(200):
        angles = rng.uniform([-1.5, -3.1, -3.1], [1.5, 3.1, 3.1])
        R = pelvis_rotation(angles)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_allclose(pelvis_angles(R), angles, atol=1e-9)


def test_the_rotation_is_yaw_then_roll_then_pitch(rng):
    for roll, pitch, yaw in rng.uniform(-1.5, 1.5, (20, 3)):
        turns = [matrix_from_rpy(x) for x in ([0, 0, yaw], [roll, 0, 0], [0, pitch, 0])]
        np.testing.assert_allclose(
            pelvis_rotation(np.array([roll, pitch, yaw])),
            turns[0] @ turns[1] @ turns[2],
            atol=1e-12,
        )


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_somebody_who_crawls_has_a_heading(yaw):
    """Trunk level or head down: yaw stays, where the usual order loses it."""
    for pitch in (math.pi / 2, math.pi / 2 + 0.3):
        R = matrix_from_rpy([0, 0, yaw]) @ matrix_from_rpy([0, pitch, 0])
        np.testing.assert_allclose(pelvis_angles(R), [0.0, pitch, yaw], atol=1e-9)


def test_angles_turn_with_the_world(rng):
    for angles in rng.uniform(-1.4, 1.4, (20, 3)):
        turned = matrix_from_rpy([0, 0, 2.0]) @ pelvis_rotation(angles)
        off = wrap(pelvis_angles(turned) - angles)
        np.testing.assert_allclose(off, [0.0, 0.0, 2.0], atol=1e-9)


# Distributions.


def test_only_what_is_narrow_is_imposed():
    d = pelvis((0.0, 1.0, 0.0), (IMPOSED - 1e-6, IMPOSED, np.inf))
    assert d.imposed[0] == pytest.approx((-IMPOSED, IMPOSED), abs=1e-5)
    assert d.imposed[1:] == (None, None)


def test_angles_are_clipped_to_what_is_imposed_the_short_way_round():
    d = pelvis((math.pi - 0.05, 0.0, 0.3), (0.1, 0.2, 2.0))
    out = d.clip(np.array([-math.pi + 0.3, -0.5, 3.0]))
    assert out[0] == pytest.approx(-math.pi + 0.05)  # across pi, not all the way back
    assert out[1] == pytest.approx(-0.2)
    assert out[2] == 3.0  # not imposed: as it was
    inside = np.array([math.pi - 0.1, 0.1, -1.0])
    np.testing.assert_allclose(d.clip(inside), inside, atol=1e-12)


def test_clipping_is_idempotent_and_never_leaves_the_range(rng):
    d = pelvis((0.2, -2.0, 3.1), (0.05, 0.3, 0.2))
    for angles in rng.uniform(-math.pi, math.pi, (100, 3)):
        once = d.clip(angles)
        np.testing.assert_allclose(d.clip(once), once, atol=1e-12)
        assert np.all(np.abs(wrap(once - d.mean)) <= d.sigma + 1e-12)


# Edges, and which distribution holds where.


def test_the_edges_are_those_before_the_start_and_before_the_goal():
    top = table().top
    up, down = climbed_edges(top, np.zeros(3), np.array([2.5, 0.1]))
    np.testing.assert_allclose(up.inward, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(down.inward, [-1.0, 0.0], atol=1e-12)
    p = np.array([0.5, 0.3, 1.0])
    assert up.distance(p) == pytest.approx(0.3)  # the near face is at x = 0.2
    assert down.distance(p) == pytest.approx(1.3)
    assert up.distance(np.array([0.0, 0.0, 0.9])) == pytest.approx(-0.2)
    assert abs(down.yaw) == pytest.approx(math.pi)


def test_a_goal_on_the_top_is_climbed_down_to_by_no_edge():
    assert len(climbed_edges(table().top, np.zeros(3), np.array([1.0, 0.2, 0.9]))) == 1


def test_edges_turn_with_the_world():
    yaw, shift = 0.8, np.array([3.0, -1.0])
    R = matrix_from_rpy([0, 0, yaw])
    there = table(yaw, R[:2, :2] @ [1.0, 0.0] + shift)
    goal = np.array([2.5, 0.1, 0.0])
    for a, b in zip(
        climbed_edges(table().top, np.zeros(3), goal),
        climbed_edges(there.top, np.array([*shift, 0.0]), R @ goal + [*shift, 0.0]),
        strict=True,
    ):
        assert wrap(np.array(b.yaw - a.yaw)) == pytest.approx(yaw)
        p = np.array([0.7, 0.2, 0.9])
        assert b.distance(R @ p + [*shift, 0.0]) == pytest.approx(a.distance(p))


EDGES = (
    Edge(point=np.array([0.2, 0.0]), inward=np.array([1.0, 0.0])),
    Edge(point=np.array([1.8, 0.0]), inward=np.array([-1.0, 0.0])),
)


def held_at(x: float, **fields) -> PelvisDistribution | None:
    p = policy(
        over_top=pelvis((0.0, 1.8, 0.4), (0.2, 0.3, 0.1)),
        near_edge=pelvis((0.1, 1.2, 0.0), (0.1, 0.4, 0.2)),
        **fields,
    )
    return pelvis_distribution(p, EDGES, np.array([x, 0.0, 0.9]), near=0.35)


def test_each_place_has_its_distribution():
    assert held_at(-0.2) is None
    at_edge, on_top = held_at(0.1), held_at(1.0)
    assert at_edge is not None
    assert on_top is not None
    np.testing.assert_allclose(at_edge.mean, [0.1, 1.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(at_edge.sigma, [0.1, 0.4, 0.2])
    np.testing.assert_allclose(on_top.mean, [0.0, 1.8, 0.4])


def test_near_both_they_are_averaged():
    both = held_at(0.4)
    assert both is not None
    np.testing.assert_allclose(both.mean, [0.05, 1.5, 0.2])
    expected = np.sqrt(np.array([0.05, 0.25, 0.05])) / 2.0
    np.testing.assert_allclose(both.sigma, expected)


def test_behind_the_far_edge_the_pelvis_faces_back_to_the_obstacle():
    at_edge = held_at(1.9)
    assert at_edge is not None
    assert abs(at_edge.mean[2]) == pytest.approx(math.pi)
    assert at_edge.mean[1] == pytest.approx(1.2)


def test_yaws_on_both_sides_of_pi_are_averaged_the_short_way():
    d = held_at(1.6)  # edge: pi, top: 0.4 against the first edge
    assert d is not None
    assert d.mean[2] == pytest.approx((math.pi + 0.4) / 2)
    p = policy(
        over_top=pelvis((0.0, 1.0, math.pi - 0.1), (0.1, 0.1, 0.1)),
        near_edge=pelvis((0.0, 1.0, 0.1), (0.1, 0.1, 0.1)),
    )
    d = pelvis_distribution(p, EDGES, np.array([1.6, 0.0, 0.9]), near=0.35)
    assert d is not None
    assert abs(wrap(np.array(d.mean[2] - math.pi))) < 1e-9


# What the records refuse.


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: option(surfaces=("LHand",)), "two or more"),
        (lambda: option(surfaces=("LHand", "LHand")), "once"),
        (lambda: option(surfaces=("LHand", "Nose")), "Nose"),
        (lambda: option(held=("Tail",)), "Tail"),
        (lambda: option(repeats=1), "2 or more"),
        (lambda: option(region="X"), "'X'"),
        (lambda: option(initiation=()), "initiation"),
        (lambda: option(initiation=("goal",)), "initiation"),
        (lambda: policy(options=()), "at least one"),
        (lambda: policy(options=(option(termination="M"),)), "termination"),
        (lambda: policy(options=(option(), option())), "termination"),
        (lambda: policy(goal=("Nose",)), "Nose"),
        (lambda: policy(reach={"LHand": 0.0}), "positive"),
        (lambda: pelvis(sigma=(-0.1, 0.1, 0.1)), "negative"),
        (lambda: pelvis(mean=(np.nan, 0, 0)), "finite"),
        (lambda: pelvis(samples=-1), "samples"),
        (lambda: demo(actions=("LHand",)), "one more state"),
        (lambda: demo(actions=("RHand", None)), "RHand"),
        (lambda: demo(actions=("Tail", None)), "Tail"),
        (lambda: Stance(contacts=FEET, pelvis=np.zeros(6)), "7 finite"),
    ],
)
def test_records_refuse_what_cannot_be(make, word):
    with pytest.raises(ValueError, match=word):
        make()


def test_records_keep_their_numbers():
    with pytest.raises(ValueError, match="read-only"):
        pelvis().mean[0] = 1.0
    with pytest.raises(TypeError):
        policy().reach["LHand"] = 1.0  # type: ignore[index]
    assert policy().sources == ("by hand",)


# The file.


def test_a_policy_survives_the_disk_to_the_last_bit(tmp_path):
    far = pelvis((0, 1, 0), (np.inf, 0.1 + 0.2, 0.0), 1)
    written = policy(near_edge=far, secondary=(policy(goal=("LKnee",)),))
    save_policy(written, tmp_path / "policy.json")
    read = load_policy(tmp_path)
    np.testing.assert_array_equal(read.near_edge.sigma, written.near_edge.sigma)
    assert read.options == written.options
    assert read.secondary[0].goal == ("LKnee",)
    assert read.demos[0].actions == ("LHand", None)
    assert dict(read.reach) == {"LHand": 0.3}
    np.testing.assert_array_equal(read.demos[0].states[0].pelvis, POSE)
    assert read.demos[0].states[1].pelvis is None
    assert read.demos[0].states[1].region == "M"
    save_policy(read, tmp_path / "again.json")
    first, second = (tmp_path / n for n in ("policy.json", "again.json"))
    assert first.read_bytes() == second.read_bytes()


def test_the_summary_is_plain_and_without_states():
    summary = policy_summary(policy(near_edge=pelvis(sigma=(np.inf, 0.1, 0.1))))
    text = json.dumps(summary, allow_nan=False)
    assert "states" not in text
    assert summary["sources"] == ["by hand"]
    assert summary["near_edge"]["sigma"][0] is None


def _set(content: dict, path: str, value: object) -> None:
    *keys, last = path.split(".")
    for key in keys:
        content = content[int(key)] if isinstance(content, list) else content[key]
    if isinstance(content, list):
        content[int(last)] = value
    else:
        content[last] = value


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("version", 7, "version"),
        ("options.0.surfaces.1", "Nose", "options.0"),
        ("options.0.repeats", 1, "options.0"),
        ("options.0.region", "X", "options.0.region"),
        ("options.0.termination", "M", None),
        ("options", [], None),
        ("near_edge.sigma.0", -1.0, "near_edge"),
        ("over_top.mean", [0.0], "over_top"),
        ("goal.0", "Tail", None),
        ("reach.LHand", -1.0, None),
        ("demos.0.actions.0", "RHand", "demos.0"),
        ("demos.0.states.0.pelvis", [0.0, 1.0], "demos.0.states.0"),
        ("secondary.0.options.0.surfaces.0", "X", "secondary.0.options.0"),
    ],
)
def test_a_wrong_field_of_the_file_is_named(tmp_path, path, value, field):
    file = tmp_path / "policy.json"
    save_policy(policy(secondary=(policy(),)), file)
    content = json.loads(file.read_text())
    _set(content, path, value)
    file.write_text(json.dumps(content))
    with pytest.raises(InputError) as e:
        load_policy(file)
    assert (e.value.source, e.value.field) == (file, field)
    assert "\n" not in str(e.value)


def test_a_truncated_or_missing_file_is_named(tmp_path):
    file = tmp_path / "policy.json"
    with pytest.raises(InputError, match=r"policy\.json.*readable"):
        load_policy(file)
    save_policy(policy(), file)
    whole = file.read_text()
    for share in (0.1, 0.5, 0.99):
        file.write_text(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"policy\.json.*whole JSON"):
            load_policy(file)
    file.write_text("[]")
    with pytest.raises(InputError, match="object"):
        load_policy(file)


def test_a_stances_pelvis_can_be_replaced_without_touching_the_rest():
    stance = Stance(contacts=FEET)
    held = replace(stance, pelvis=POSE)
    assert stance.pelvis is None
    assert held.contacts == stance.contacts
    with pytest.raises(ValueError, match="read-only"):
        held.pelvis[0] = 2.0  # type: ignore[index]

"""Contacts are found again in recordings whose true contacts are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import savgol_filter

from clamber.contact.contact import DIRECTIONS, ContactInterval, ContactSequence
from clamber.errors import InputError
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy
from clamber.recording.demonstration import (
    Demonstration,
    RawTracks,
    build_demonstration,
)
from clamber.recording.detect import (
    SEAT,
    DetectOptions,
    detect_contacts,
    fit_instant,
    hysteresis,
    local_quadratics,
    noise_of,
)
from support.climb import ClimbOptions, synthesize_climb

ORDER = ("LHand", "RHand", "LElbow", "RElbow", "LKnee", "RKnee")


@cache
def climb(seed: int = 0, **options) -> tuple[Demonstration, list[ContactInterval]]:
    rng = np.random.default_rng(seed)
    return synthesize_climb(rng, options=ClimbOptions(**options))


def errors(sequence: ContactSequence, truth: list[ContactInterval]) -> np.ndarray:
    """(N, 2) errors of start and end [s]; fails unless the very same contacts exist."""
    found = {(i.part, i.contact.support): i for i in sequence.intervals}
    true = {(i.part, i.contact.support): i for i in truth}
    assert len(found) == len(sequence.intervals)
    assert set(found) == set(true)
    return np.array([[found[k].t0 - i.t0, found[k].t1 - i.t1] for k, i in true.items()])


@pytest.mark.parametrize(
    "options",
    [
        {"noise": 0.0},
        {"seed": 1},
        {"seed": 2, "noise": 0.005},
        {"height_ratio": 0.57},
        {"height_ratio": 1.12},
        {"mirrored": True, "noise": 0.005},
        {"speed": 2.0, "noise": 0.005},
        {"gaps": 25},
        {"rate": 60.0},
        {"rate": 240.0},
        {"elbow_side": 0.27},
    ],
    ids=str,
)
def test_true_contacts_and_no_others_are_found_within_50_ms(options):
    demo, truth = climb(**{"seed": 5, **options})
    assert np.abs(errors(detect_contacts(demo), truth)).max() < 0.05


def test_a_slow_climb_is_found_though_its_landings_are_gentle():
    demo, truth = climb(1, speed=0.5)
    assert np.abs(errors(detect_contacts(demo), truth)).max() < 0.1


def test_places_and_headings_are_those_of_the_contact():
    demo, truth = climb()
    true = {i.part: i.contact for i in truth}
    for i in detect_contacts(demo).intervals:
        there = true[i.part]
        np.testing.assert_allclose(i.contact.position, there.position, atol=5e-3)
        R, R_true = (matrix_from_quat(c.quaternion) for c in (i.contact, there))
        np.testing.assert_allclose(R[:, 2], [0, 0, 1], atol=1e-9)
        if not i.part.endswith("Hand"):  # a hand's heading follows the forearm
            assert R[:, 0] @ R_true[:, 0] > np.cos(0.15)


def test_stances_show_the_climb_in_order():
    demo, _ = climb()
    sequence = detect_contacts(demo)
    regions = "".join(s.region for s in sequence.stances)
    assert regions == "GMMMMMMOO"
    made, before = [], set()
    for stance in sequence.stances:
        made += [x for x in stance.surfaces if x not in before]
        before = set(stance.surfaces)
    assert made == ["LFoot", "RFoot", *ORDER]
    assert set(sequence.stances[-1].surfaces) == set(ORDER)
    assert sequence.subject is not None
    assert sequence.subject["forearm"] == pytest.approx(0.254, abs=2e-3)


def test_a_contact_that_goes_on_keeps_its_pose_over_stances():
    demo, _ = climb()
    stances = detect_contacts(demo).stances
    for a, b in pairwise(stances):
        for contact in a.contacts:
            later = b.contact(contact.surface)
            assert later is None or later is contact


def test_posture_directions_are_the_recorded_ones():
    demo, _ = climb(noise=0.0, gaps=0)
    first = detect_contacts(demo).stances[0]
    assert set(first.posture) == set(DIRECTIONS)
    for direction in first.posture.values():
        assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert first.posture["trunk"] @ [0, 0, 1] > 0.95
    k = np.searchsorted(demo.t, 20.0)
    shank = demo.point("LFoot")[k] - demo.point("LKnee")[k]
    last = detect_contacts(demo).stances[-1].posture["left_shank"]
    np.testing.assert_allclose(last, shank / np.linalg.norm(shank), atol=1e-6)


def test_detection_does_not_depend_on_where_the_world_lies():
    demo, _ = climb(noise=0.0, gaps=0)
    angle, shift = 0.7, np.array([3.0, -2.0, 0.0])
    R = matrix_from_rpy([0, 0, angle])
    box = demo.scene.boxes[0]
    there = replace(box, centre=R @ box.centre + shift, rotation=R @ box.rotation)
    scene = Scene(boxes=(there,), start=np.array([3.0, -2.0, angle]))
    moved = replace(demo, position=demo.position @ R.T + shift, scene=scene)
    for a, b in zip(
        detect_contacts(demo).intervals, detect_contacts(moved).intervals, strict=True
    ):
        assert a.part == b.part
        assert (a.t0, a.t1) == pytest.approx((b.t0, b.t1), abs=1e-9)
        np.testing.assert_allclose(
            R @ a.contact.position + shift, b.contact.position, atol=1e-9
        )


def test_without_the_box_nothing_touches_it():
    demo, _ = climb()
    bare = detect_contacts(demo, scene=Scene(boxes=(), start=np.zeros(3)))
    assert {(i.part, i.contact.support) for i in bare.intervals} == {
        ("LFoot", GROUND),
        ("RFoot", GROUND),
    }


def test_a_part_out_of_sight_is_not_said_to_be_in_contact():
    demo, _ = climb(noise=0.0, gaps=0)
    valid = demo.valid.copy()
    blind = (demo.t > 15.0) & (demo.t < 17.0)
    valid[blind, demo.names.index("LElbow")] = False
    spans = [
        (i.t0, i.t1)
        for i in detect_contacts(replace(demo, valid=valid)).intervals
        if i.part == "LElbow"
    ]
    assert len(spans) == 2
    assert spans[0][1] == pytest.approx(15.0, abs=0.02)
    assert spans[1][0] == pytest.approx(17.0, abs=0.02)


def seated(demo: Demonstration) -> Demonstration:
    """The person sitting on the near edge, shanks hanging down in front of it."""
    box = demo.scene.boxes[0]
    edge, h = box.centre[0] - box.size[0] / 2, box.size[2]
    place = {
        "Pelvis": (0.35, 0.0, 0.10), "Hip": (0.35, 0.10, 0.10),
        "Knee": (0.02, 0.10, 0.08), "Foot": (0.0, 0.10, 0.08 - 0.453),
        "Foot.toe": (-0.14, 0.10, 0.03 - 0.453), "Shoulder": (0.35, 0.16, 0.63),
        "Elbow": (0.33, 0.20, 0.35), "Hand": (0.20, 0.18, 0.25),
        "Hand.knuckle": (0.12, 0.18, 0.25), "Hand.tip": (0.05, 0.18, 0.25),
        "Neck": (0.35, 0.0, 0.7), "Head": (0.35, 0.0, 0.85),
    }  # fmt: skip
    still = np.zeros((len(demo.t), len(demo.names), 3))
    for f, name in enumerate(demo.names):
        sided = name[0] in "LR"
        x, y, z = place[name[1:] if sided else name]
        still[:, f] = [edge + x, -y if name[0] == "R" else y, h + z]
    return replace(demo, position=still)


def test_sitting_is_a_seat_and_never_a_contact_of_the_knees():
    demo = seated(climb(noise=0.0, gaps=0, height_ratio=1.12)[0])
    with pytest.raises(InputError, match="at least one contact"):
        detect_contacts(demo)  # a seat alone makes no stance
    hand = demo.position.copy()
    for f, name in enumerate(demo.names):
        if name.startswith("LHand"):
            hand[:, f, 2] = demo.scene.boxes[0].size[2] + 0.02
    sequence = detect_contacts(replace(demo, position=hand))
    kinds = {(i.part, i.is_surface) for i in sequence.intervals}
    assert kinds == {("LHand", True), (SEAT, False)}
    assert sequence.stances[0].surfaces == ("LHand",)


def test_a_standing_knee_over_a_low_box_does_not_kneel():
    demo, _ = climb(noise=0.0, gaps=0)
    h = demo.point("LKnee")[0, 2] - 0.08  # just under the knee of the standing person
    boxes = (replace(demo.scene.boxes[0], size=np.array([3, 3, h])),)
    boxes = (replace(boxes[0], centre=np.array([1.45, 0, h / 2])),)
    still = replace(demo, position=np.repeat(demo.position[:1], len(demo.t), axis=0))
    found = detect_contacts(still, scene=Scene(boxes=boxes, start=np.zeros(3)))
    assert not [i for i in found.intervals if i.part.endswith("Knee")]


def test_a_hand_that_rolls_up_after_it_has_touched_is_found_when_it_touches():
    demo, truth = climb(noise=0.001, gaps=0)
    p = demo.position.copy()
    true = {(i.part, i.contact.support): i for i in truth}["LHand", "table"]
    since = np.clip((demo.t - true.t0) / 0.5, 0.0, 1.0)
    for f, name in enumerate(demo.names):
        if name.startswith("LHand"):
            p[:, f, 2] += 0.03 * since**2 * (3 - 2 * since)
    found = detect_contacts(replace(demo, position=p))
    (hand,) = [i for i in found.intervals if i.part == "LHand"]
    assert abs(hand.t0 - true.t0) < 0.1


@pytest.mark.parametrize("size", [0.6, 1.2])
def test_a_person_of_another_size_makes_the_same_contacts(size):
    demo, truth = climb(noise=0.001, gaps=0)
    box = demo.scene.boxes[0]
    scene = Scene(
        boxes=(replace(box, size=size * box.size, centre=size * box.centre),),
        start=demo.scene.start,
    )
    scaled = build_demonstration(
        RawTracks(
            source="x",
            names=demo.names,
            position=size * demo.position,
            rate=demo.rate,
            scene=scene,
        )
    )
    assert scaled.offsets["Knee"] == pytest.approx(size * demo.offsets["Knee"])
    assert np.abs(errors(detect_contacts(scaled), truth)).max() < 0.06


def test_offsets_move_the_heights_at_which_a_part_may_rest():
    """Knees whose points lie 9 cm higher than usual, as on thick pads."""
    demo, truth = climb(noise=0.001, gaps=0)
    p = demo.position.copy()
    for side in "LR":
        p[:, demo.names.index(side + "Knee"), 2] += 0.09
    padded = replace(demo, position=p)
    parts = {i.part for i in detect_contacts(padded).intervals}
    assert not parts & {"LKnee", "RKnee"}
    told = replace(padded, offsets={**demo.offsets, "Knee": 0.20})
    assert np.abs(errors(detect_contacts(told), truth)).max() < 0.06


def test_a_hand_that_rests_in_the_air_touches_nothing():
    demo, _ = climb(noise=0.0, gaps=0)
    p = demo.position.copy()
    for f, name in enumerate(demo.names):
        if name.startswith("LHand"):
            p[:, f, 2] += 0.12
    found = detect_contacts(replace(demo, position=p))
    assert "LHand" not in {i.part for i in found.intervals}


def test_changes_closer_than_merge_are_one_change_of_stance():
    demo, _ = climb()
    apart = detect_contacts(demo)
    together = detect_contacts(demo, options=DetectOptions(merge=2.5))
    assert len(together.stances) < len(apart.stances)
    assert [(i.part, i.t0) for i in together.intervals] == [
        (i.part, i.t0) for i in apart.intervals
    ]


def test_hysteresis_begins_strict_and_lasts_while_loose():
    loose = np.array([1, 1, 0, 1, 1, 1, 1, 1, 0, 1, 1, 0, 1, 1], dtype=bool)
    strict = np.array([0, 1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 0, 1, 0], dtype=bool)
    assert hysteresis(strict, loose, 2) == [(0, 2), (4, 8), (12, 14)]
    assert hysteresis(strict, loose, 3) == [(4, 8)]


@pytest.mark.parametrize("n", [5, 25, 199])
@pytest.mark.parametrize("order", [0, 1])
def test_smoothing_is_that_of_savitzky_and_golay(rng, n, order):
    x = np.cumsum(rng.normal(size=(200, 3, 2)), axis=0)
    expected = savgol_filter(x, n, 2, deriv=order, axis=0)
    assert np.allclose(local_quadratics(x, n, order), expected, atol=1e-11)


def test_noise_is_measured_on_a_moving_track(rng):
    t = np.linspace(0, 10, 1200)[:, None]
    track = np.sin(t * [1.0, 2.0, 0.5]) + 0.004 * rng.standard_normal((1200, 3))
    assert noise_of(track) == pytest.approx(0.004, rel=0.1)


@pytest.mark.parametrize("true", [45, 52, 58])
def test_the_instant_of_touching_is_fitted_through_noise(rng, true):
    s = np.arange(100)
    p = np.maximum(true - s, 0)[:, None] / 120 * [0.1, 0.0, 0.35]
    p = p + 0.002 * rng.standard_normal((100, 3))
    assert abs(fit_instant(p, 50, 12) - true) <= 2

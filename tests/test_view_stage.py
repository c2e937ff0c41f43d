"""The scene of the view: shapes have the sizes that they mean, links hang where bodies
are, and what is not there is not drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import clamber
from clamber.contact.contact import ContactSequence
from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.show.pictures import PHASE_COLOURS
from clamber.show.sample import bearing_of
from clamber.show.view import edits
from clamber.show.view.person import beside, change_times, figure_at, show_person
from clamber.show.view.shown import (
    ALIKE,
    ALIKE_TURNED,
    ARROW,
    AT_REST,
    PUSH_SCALE,
    Shown,
    Touch,
    apart,
    beams,
    frame_at,
    show_run,
    stance_at,
    tube,
    way_at,
    weight_of,
)
from clamber.step.statics import support_ellipse

UP = np.array([0.0, 0.0, 1.0])


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Of a closed surface, positive where its faces look outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def quaternion(axis: Any, angle: float) -> np.ndarray:
    q = np.zeros(4)
    mujoco.mju_axisAngle2Quat(q, np.asarray(axis, dtype=float), angle)
    return q


# Shapes.


def test_a_tube_is_closed_and_as_thick_as_it_says():
    line = np.stack([np.linspace(0, 2, 40), np.zeros(40), np.zeros(40)], axis=1)
    vertices, faces = tube(line, 0.1, 64)
    wanted = math.pi * 0.1**2 * 2 + 4 / 3 * math.pi * 0.1**3
    assert volume(vertices, faces) == pytest.approx(wanted, rel=0.03)
    turned = line @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    assert volume(*tube(turned, 0.1, 64)) == pytest.approx(wanted, rel=0.03)


def test_a_tube_around_a_curve_keeps_its_distance(rng: np.random.Generator):
    a = np.linspace(0, math.pi, 60)
    line = np.stack([np.cos(a), 0 * a, np.sin(a)], axis=1)
    vertices, _ = tube(line, 0.05, 8)
    gaps = np.linalg.norm(vertices[:, None] - line[None], axis=2).min(axis=1)
    assert gaps.max() <= 0.05 + 1e-3
    assert np.median(gaps) == pytest.approx(0.05, abs=2e-3)


def test_a_tube_of_one_point_is_a_ball():
    for points in (np.zeros((1, 3)), np.zeros((3, 3))):
        vertices, faces = tube(points, 0.1, 48)
        assert np.isfinite(vertices).all()
        assert volume(vertices, faces) == pytest.approx(4 / 3 * math.pi * 1e-3, rel=0.1)


@pytest.mark.parametrize(
    "way", [[1, 0, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1], [1, 2, 3]]
)
def test_a_beam_has_its_width_all_along(way: list[float]):
    start = np.array([0.3, -0.2, 0.1])
    end = start + np.array(way, dtype=float)
    vertices, faces = beams(np.array([[start, end]]), 0.02)
    for ring, point in ((vertices[:3], start), (vertices[3:], end)):
        np.testing.assert_allclose(ring.mean(axis=0), point, atol=1e-12)
        sides = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, 0.02)
        np.testing.assert_allclose((ring - point) @ np.array(way), 0.0, atol=1e-12)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    middle = (start + end) / 2
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - middle)
    assert np.all(outward > 0)


def test_beams_without_length_have_faces_but_no_size():
    segments = np.array([[[0.0, 0, 0], [1, 0, 0]], [[2.0, 2, 2], [2, 2, 2]]])
    vertices, faces = beams(segments, 0.02)
    assert len(vertices) == 12
    assert len(faces) == 12
    assert faces.max() == 11
    np.testing.assert_allclose(vertices[6:9], vertices[9:12])
    assert np.isfinite(vertices).all()


def test_a_link_of_the_ghost_is_seen_where_it_is_elsewhere():
    pose = np.array([[0.1, 0.2, 0.3, *quaternion([0, 1, 0], 0.7)]])
    near, far, turned, little = (pose.copy() for _ in range(4))
    near[0, 0] += 0.9 * ALIKE
    far[0, 1] -= 1.1 * ALIKE
    turned[0, 3:] = quaternion([0, 1, 0], 0.7 + 1.1 * ALIKE_TURNED)
    little[0, 3:] = quaternion([0, 1, 0], 0.7 + 0.9 * ALIKE_TURNED)
    other = pose * np.array([1, 1, 1, -1, -1, -1, -1])  # the same rotation
    many = np.concatenate([pose, near, far, turned, little, other])
    wanted = [False, False, True, True, False, False]
    assert apart(many, np.repeat(pose, 6, axis=0)).tolist() == wanted


# What is seen at a time.


def test_margin_and_polygon_are_those_of_the_bearing_points(ran: Shown):
    """Against qhull, and against the corners of the feet as the model has them."""
    kin = Kinematics(ran.world)
    for share in (0.1, 0.5, 1.0):
        frame = frame_at(ran, kin, share * ran.duration)
        kin.update(ran.q[frame.row])
        points = np.concatenate(
            [
                bearing_of(kin, x.surface, ran.world.supports[x.support])
                for x in frame.touches
                if x.loaded
            ]
        )
        hull = ConvexHull(points[:, :2])
        gaps = -(hull.equations[:, :2] @ kin.com[:2] + hull.equations[:, 2])
        assert frame.margin == pytest.approx(gaps.min(), abs=1e-6)
        assert ConvexHull(frame.polygon[:, :2]).volume == pytest.approx(hull.volume)
        assert frame.foot[2] == frame.polygon[0, 2] == points[:, 2].max()
        np.testing.assert_allclose(frame.com, kin.com)


def test_standing_on_two_feet_the_polygon_reaches_from_sole_to_sole(planned: Shown):
    frame = frame_at(planned, Kinematics(planned.world), 0.0)
    feet = [x.position for x in frame.touches]
    assert len(feet) == 2
    width = np.ptp(frame.polygon[:, 1])
    assert width > abs(feet[0][1] - feet[1][1])
    assert frame.margin < width / 2
    np.testing.assert_allclose(frame.polygon[:, 2], 0.0, atol=2e-3)


def test_the_ellipse_is_drawn_around_its_foci(ran: Shown):
    frame = frame_at(ran, Kinematics(ran.world), ran.duration)
    e = support_ellipse(frame.polygon[:, :2])
    length = np.linalg.norm(frame.ellipse[:, None, :2] - e.foci, axis=2).sum(axis=1)
    np.testing.assert_allclose(length, e.string_length, rtol=1e-9)
    np.testing.assert_allclose(frame.ellipse[:, :2].mean(axis=0), e.centre)


def test_before_the_beginning_and_after_the_end_time_stands_still(ran: Shown):
    kin = Kinematics(ran.world)
    for outside, end in ((-5.0, 0.0), (ran.duration + 5.0, ran.duration)):
        a, b = (frame_at(ran, kin, t) for t in (outside, end))
        assert a.row == b.row
        np.testing.assert_array_equal(a.poses, b.poses)
        assert a.stance == b.stance
    assert stance_at(ran, -1.0) == 0
    assert stance_at(ran, 1e9) == len(ran.reached) - 1


def test_nothing_that_bears_is_no_polygon_and_no_force(
    one_hand_plan: Plan, one_hand_rollout: Rollout
):
    force = np.zeros_like(one_hand_rollout.contact_force)
    shown = show_run(one_hand_plan, replace(one_hand_rollout, contact_force=force))
    kin = Kinematics(shown.world)
    frame = frame_at(shown, kin, 0.5 * shown.duration)
    assert len(frame.polygon) == len(frame.ellipse) == 0
    assert math.isnan(frame.margin)
    assert frame.foot[2] == 0.0
    assert {x.surface for x in frame.touches} >= {"LFoot", "RFoot"}  # planned ones
    assert all(x.force is None and not x.loaded for x in frame.touches)
    assert all(x.phase != "supporting" for x in frame.touches)


def test_phases_follow_from_distance_length_and_friction(ran: Shown):
    """d <= l sin(min(atan(mu), 25 deg)) of the limb's root over its contact."""
    kin = Kinematics(ran.world)
    frame = frame_at(ran, kin, ran.duration)
    for touch in frame.touches:
        mass = kin.landmark(ran.world.robot.limb_of(touch.surface).root)[1]
        way = mass - touch.position
        bound = min(math.atan(touch.friction), math.radians(25.0))
        inside = np.hypot(*way[:2]) <= np.linalg.norm(way) * math.sin(bound)
        assert (touch.phase == "supporting") == (inside and touch.loaded)


def test_a_plan_knows_forces_only_near_its_keyframes(planned: Shown):
    kin, at = Kinematics(planned.world), planned.reached[1]
    assert at is not None
    for off, known in ((0.0, True), (0.9 * AT_REST, True), (1.5 * AT_REST, False)):
        frame = frame_at(planned, kin, at - off)
        assert any(x.force is not None for x in frame.touches) == known


def test_a_push_points_at_the_pelvis_along_its_force(
    one_hand_plan: Plan, one_hand_rollout: Rollout
):
    push = np.zeros((len(one_hand_rollout.ctrl), 3))
    push[500:900] = [0.0, 60.0, 0.0]
    shown = show_run(one_hand_plan, replace(one_hand_rollout, push=push))
    kin = Kinematics(shown.world)
    frame = frame_at(shown, kin, 0.7)
    assert frame.push is not None
    kin.update(shown.q[frame.row])
    np.testing.assert_allclose(frame.push[1], kin.data.xpos[shown.world.base])
    length = PUSH_SCALE * ARROW * 60.0 / weight_of(shown.world)
    np.testing.assert_allclose(frame.push[1] - frame.push[0], [0.0, length, 0.0])
    assert frame_at(shown, kin, 0.2).push is None


def test_a_plan_of_one_stance_has_an_instant_and_no_way(one_hand_plan: Plan):
    alone = replace(
        one_hand_plan,
        keyframes=one_hand_plan.keyframes[:1],
        paths=(),
        trajectory=None,
        complete=False,
    )
    shown = show_run(alone, None)
    assert shown.duration == 0.0
    assert shown.events() == [0.0]
    assert way_at(shown, 0.0) is None
    frame = frame_at(shown, Kinematics(shown.world), 0.0)
    assert frame.stance == 0
    assert {x.surface for x in frame.touches} == {"LFoot", "RFoot"}
    total = np.sum([x.force for x in frame.touches if x.force is not None], axis=0)
    np.testing.assert_allclose(total, weight_of(shown.world) * UP, atol=1.0)


def test_the_way_keeps_clear_of_the_box_until_its_end(planned: Shown):
    """Its middle is over the edge by more than what is kept free around it."""
    way = way_at(planned, 0.0)
    assert way is not None
    box = planned.world.scene.boxes[0]
    local = np.abs((way.points - box.position) @ box.rotation) - box.size / 2
    gap = np.linalg.norm(np.maximum(local, 0.0), axis=1)
    surface = planned.world.surfaces[way.surface]
    assert gap[: len(gap) // 2].min() > way.radius - 1e-3
    assert gap[-1] == pytest.approx(surface.radius, abs=0.01)


# Nodes of the page, against a scene that only keeps what it is sent.


class Kept:
    """In place of the scene of a server: nodes by name, and what was set anew."""

    def __init__(self) -> None:
        self.nodes: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if not name.startswith("add_"):
            raise AttributeError(name)

        def add(node: str, *args: Any, **options: Any) -> Any:
            pose = {"position": np.zeros(3), "wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
            made = Node(args=args, **{**pose, **options})
            self.nodes[node] = made
            return made

        return add


class Node(SimpleNamespace):
    """Counts assignments."""

    def __setattr__(self, name: str, value: Any) -> None:
        self.__dict__.setdefault("sent", []).append(name)
        self.__dict__[name] = value


@pytest.fixture
def kept() -> Any:
    pytest.importorskip("viser")
    scene = Kept()
    return SimpleNamespace(scene=scene)


def test_links_that_hang_in_one_another_are_where_the_bodies_are(kept: Any, ran: Shown):
    from clamber.show.view.stage import Links

    links = Links(kept, "/robot", ran.world, ran.meshes)
    kin = Kinematics(ran.world)
    rows = [0, len(ran.q) // 2, len(ran.q) - 1]
    for row in rows:
        frame = frame_at(ran, kin, float(ran.time[row]))
        links.pose(frame.poses)
        bodies = [m.body for m in ran.meshes]
        for name in kept.scene.nodes:
            if "mesh" in name or name == "/robot":
                continue
            p, q = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            parts = name.split("/")[2:]
            for k in range(len(parts)):  # from the pelvis outwards
                up = kept.scene.nodes["/".join(["/robot", *parts[: k + 1]])]
                turned, product = np.zeros(3), np.zeros(4)
                mujoco.mju_rotVecQuat(turned, np.asarray(up.position), q)
                mujoco.mju_mulQuat(product, q, np.asarray(up.wxyz))
                p, q = p + turned, product
            pose = frame.poses[bodies.index(int(parts[-1]))]
            np.testing.assert_allclose(p, pose[:3], atol=3e-4)
            assert abs(q @ pose[3:]) == pytest.approx(1.0, abs=1e-6)


def test_a_link_that_has_not_moved_is_not_sent(kept: Any, ran: Shown):
    from clamber.show.view.stage import Links

    links = Links(kept, "/robot", ran.world, ran.meshes)
    poses = frame_at(ran, Kinematics(ran.world), ran.duration).poses.copy()
    links.pose(poses)
    for node in kept.scene.nodes.values():
        node.__dict__["sent"] = []
    links.pose(poses)
    assert not any(node.sent for node in kept.scene.nodes.values())
    poses[:, 0] += 0.01  # the whole robot: that is its pelvis alone
    links.pose(poses)
    sent = [name for name, node in kept.scene.nodes.items() if node.sent]
    assert [name.count("/") for name in sent] == [2]


def test_a_ghost_is_sent_where_it_is_seen_and_what_that_hangs_in(kept: Any, ran: Shown):
    from clamber.show.view.stage import Links

    links = Links(kept, "/ghost", ran.world, ran.meshes, ghost=True)
    frame = frame_at(ran, Kinematics(ran.world), ran.duration / 2)
    nodes, seen = kept.scene.nodes, np.zeros(len(ran.meshes), dtype=bool)
    for node in nodes.values():
        node.__dict__["sent"] = []
    links.pose(frame.poses, seen)
    assert not any("position" in n.sent or "wxyz" in n.sent for n in nodes.values())
    assert not any(n.visible for name, n in nodes.items() if "/mesh/" in name)
    deepest = max((n for n in nodes if "/mesh" not in n), key=lambda n: n.count("/"))
    body = int(deepest.split("/")[-1])
    seen[[m.body for m in ran.meshes].index(body)] = True
    links.pose(frame.poses, seen)
    shown = {n.split("/mesh")[0] for n, x in nodes.items() if getattr(x, "visible", 0)}
    assert shown == {deepest}
    moved = {n for n, x in nodes.items() if "wxyz" in x.sent or "position" in x.sent}
    chain = {deepest[:i] for i, c in enumerate(deepest) if c == "/"} | {deepest}
    assert moved <= chain
    assert deepest in moved


def test_a_cone_opens_by_the_angle_of_friction(kept: Any):
    from clamber.show.view.stage import CONE_HEIGHT, cones, discs, linear

    tilted = np.array([0.0, math.sin(0.3), math.cos(0.3)])
    touches = [
        Touch(
            surface="LHand",
            support="box",
            position=np.array([0.1, 0.2, 0.3]),
            normal=normal,
            friction=mu,
            loaded=True,
            phase="supporting",
            force=None,
        )
        for mu, normal in ((0.8, UP), (0.3, tilted))
    ]
    cones(kept, "/cones", 4).show(touches)
    node = kept.scene.nodes["/cones"]
    vertices = node.args[0]
    rim = vertices[np.isclose(vertices[:, 2], CONE_HEIGHT)]
    for i, touch in enumerate(touches):
        wide = rim * node.batched_scales[i]
        radius = np.hypot(wide[:, 0], wide[:, 1]).max()
        assert radius / wide[0, 2] == pytest.approx(touch.friction, rel=1e-6)
        axis = np.zeros(3)
        mujoco.mju_rotVecQuat(axis, UP, node.batched_wxyzs[i])
        np.testing.assert_allclose(axis, touch.normal, atol=1e-12)
    assert np.all(node.batched_scales[2:] < 1e-3)  # the others are not there
    dark, mid, light = linear((0, 188, 255))  # mid grey is half of the light
    assert (dark, mid, light) == (0, 128, 255)
    for colour, touch in zip(node.batched_colors, touches, strict=False):
        assert colour.tolist() == linear(PHASE_COLOURS[touch.phase]).tolist()
    discs(kept, "/discs", 4).show(touches)
    flat = kept.scene.nodes["/discs"]
    assert flat.batched_scales[0].tolist() == flat.batched_scales[1].tolist()
    off = np.linalg.norm(flat.batched_positions[:2] - touches[0].position, axis=1)
    assert off.max() < 0.01


def test_without_polygon_there_is_none_to_draw(kept: Any, ran: Shown):
    from clamber.show.view.stage import Balance

    balance = Balance(kept, "/balance")
    nodes = kept.scene.nodes
    frame = frame_at(ran, Kinematics(ran.world), ran.duration)
    balance.show(frame)
    assert nodes["/balance/area"].visible
    area = nodes["/balance/area"]
    corners = np.unique(np.asarray(area.vertices).round(4), axis=0)
    np.testing.assert_allclose(
        ConvexHull(corners[:, :2]).volume,
        ConvexHull(frame.polygon[:, :2]).volume,
        rtol=0.03,
    )
    assert nodes["/balance/rim"].vertices.shape == nodes["/balance/rim"].args[0].shape
    np.testing.assert_allclose(nodes["/balance/com"].position, frame.com, atol=6e-4)
    empty = np.zeros((0, 3))
    balance.show(replace(frame, polygon=empty, ellipse=empty))
    for name in ("area", "rim", "ring"):
        assert not nodes[f"/balance/{name}"].visible
    line = frame.polygon[:2]
    balance.show(replace(frame, polygon=line, ellipse=empty))
    assert not nodes["/balance/area"].visible
    assert nodes["/balance/rim"].visible


def test_limbs_let_see_the_forces_in_them_and_no_others(kept: Any, ran: Shown):
    from clamber.show.view.stage import Stage

    kept.scene.nodes = {}
    stage = Stage(kept, ran, "/run")
    frame = frame_at(ran, Kinematics(ran.world), ran.duration)

    def clear() -> set[int]:
        stage.show(frame)
        robot = {n: x for n, x in kept.scene.nodes.items() if "/robot/" in n}
        return {
            int(name.split("/")[-3])
            for name, node in robot.items()
            if "/mesh/" in name and node.opacity is not None
        }

    bodies = {m.body for m in ran.meshes if m.body}
    bearing = {
        ran.world.surfaces[x.surface].body for x in frame.touches if x.force is not None
    }
    assert bearing & bodies <= clear() < bodies
    stage.layer("forces", False)
    assert clear() == set()
    stage.layer("see-through robot", True)
    assert clear() == bodies


# Edits.


@pytest.fixture(scope="module")
def two_hands_plan(one_hand: ContactSequence, coman: Any) -> Plan:
    left = one_hand.stances[1].contacts
    mirrored = left[-1].position * np.array([1.0, -1.0, 1.0])
    right = replace(left[-1], surface="RHand", position=mirrored)
    both = replace(one_hand.stances[1], contacts=(*left, right))
    sequence = replace(
        one_hand, stances=(*one_hand.stances, both), t=np.array([0.0, 1.0, 2.0, 3.0])
    )
    return clamber.plan(sequence, coman, one_hand.scene)


def test_a_spell_holds_from_its_stance_to_its_end(two_hands_plan: Plan):
    spells = edits.spells_of(two_hands_plan)
    assert [(s.contact.surface, s.first, s.last) for s in spells] == [
        ("LHand", 1, 3),
        ("RHand", 2, 3),
    ]
    assert spells[0].name == "LHand on box, stance 1"
    for spell, keyframe in zip(spells, two_hands_plan.keyframes[1:], strict=True):
        made = [c for c in keyframe.stance if c.surface == spell.contact.surface]
        np.testing.assert_array_equal(spell.planned, made[0].position)
    steps = edits.keyframe_steps(two_hands_plan)
    assert [(i, step.stance) for i, step in steps] == [(1, 1), (2, 2)]


def test_a_moved_contact_is_moved_in_all_stances_that_hold_it(two_hands_plan: Plan):
    place = np.array([0.5, 0.1, 0.25])
    new = edits.edited_sequence(two_hands_plan, edits.Edits(moved={0: place}))
    old = two_hands_plan.sequence
    for i, (a, b) in enumerate(zip(old.stances, new.stances, strict=True)):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            if c.surface == "LHand":
                np.testing.assert_allclose(d.position, place)
                assert d.fixed
                assert i >= 1
            else:
                assert d is c
    assert not edits.Edits()
    assert edits.Edits(off=frozenset({"LHand"}))


def test_what_is_moved_off_its_support_is_put_on_its_border():
    top = Scene.from_height(0.25).supports[1]
    half = top.polygon.max(axis=0)
    middle = top.position
    for way in ([1, 0, 0], [0, -1, 0], [1, 1, 0]):
        point = edits.clamped(top, middle + 5.0 * np.array(way, dtype=float))
        inset = half - np.abs(top.rotation.T @ (point - middle))[:2]
        assert inset.min() == pytest.approx(edits.INSET, rel=0.6)
    inner = edits.clamped(top, middle + np.array([0.1, 0.1, 4.0]))
    np.testing.assert_allclose(inner, middle + np.array([0.1, 0.1, 0.0]), atol=1e-12)


# The person.


def test_between_samples_the_figure_is_between_them(demo_sequence: ContactSequence):
    demo = clamber.load_demo("climb")
    person = show_person(demo, demo_sequence, np.array([1.0, 2.0, 3.0]))
    k = 150
    t = 0.25 * demo.t[k] + 0.75 * demo.t[k + 1]
    figure = figure_at(person, float(t))
    wanted = 0.25 * person.position[k] + 0.75 * person.position[k + 1]
    np.testing.assert_allclose(figure.joints, wanted[person.joints], atol=1e-9)
    np.testing.assert_allclose(figure.bones, wanted[person.bones], atol=1e-9)
    first = figure_at(person, -1e9)
    np.testing.assert_allclose(first.joints, person.position[0, person.joints])


def test_bones_keep_their_length_and_those_unseen_say_so(
    demo_sequence: ContactSequence,
):
    demo = clamber.load_demo("climb")
    person = show_person(demo, demo_sequence, np.zeros(3))
    thigh = demo.names.index("LHip"), demo.names.index("LKnee")
    row = [tuple(b) for b in person.bones.tolist()].index(thigh)
    lengths = [
        np.linalg.norm(np.subtract(*figure_at(person, float(t)).bones[row]))
        for t in demo.t[::80]
    ]
    assert np.std(lengths) < 0.01
    valid = demo.valid.copy()
    valid[100, demo.names.index("LKnee")] = False
    hidden = show_person(replace(demo, valid=valid), demo_sequence, np.zeros(3))
    seen = figure_at(hidden, float(demo.t[100])).seen
    knee = (hidden.bones == demo.names.index("LKnee")).any(axis=1)
    assert not seen[knee].any()
    assert seen[~knee].all()


def test_the_figure_touches_what_its_stance_says(demo_sequence: ContactSequence):
    """In the middle of each stance; not before a contact begins, nor at its end."""
    person = show_person(clamber.load_demo("climb"), demo_sequence, np.zeros(3))
    for i, stance in enumerate(demo_sequence.stances):
        middle = float(demo_sequence.t[i : i + 2].mean())
        found = {x.surface for x in figure_at(person, middle).touches}
        assert found >= set(stance.surfaces)
    hand = next(x for x in demo_sequence.intervals if x.part == "LHand")
    for t, there in ((hand.t0 - 1e-4, False), (hand.t0, True), (hand.t1, False)):
        touches = figure_at(person, t).touches
        assert ("LHand" in [x.surface for x in touches]) == there
    bare = show_person(clamber.load_demo("climb"), None, np.zeros(3))
    assert figure_at(bare, 1.0).touches == ()
    ends = [float(bare.demo.t[0]), float(bare.demo.t[-1])]
    assert change_times(bare) == ends
    assert change_times(person) == sorted({*ends, *demo_sequence.t[1:-1].tolist()})


def test_the_person_stands_to_the_right_as_the_robot_faces():
    """A robot that faces y has its right at x; the two begin abreast."""
    scene = replace(Scene.from_height(0.25), start=np.array([2.0, 1.0, math.pi / 2]))
    other = Scene.from_height(0.25)
    points = np.array([[2.0, 1.0, 0.5]])
    way = beside(scene, points, other, np.zeros((1, 3)))
    assert way[0] > 2.0
    assert way[1] == pytest.approx(1.0)
    assert way[2] == 0.0

"""Robot, scene, contacts, forces and person as nodes of a page.

Nodes are made once; of them only poses and lines are sent afterwards, and only what has
changed: viser compares.

Shapes: n samples, nb drawn bodies, nS surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.scene import Support
from clamber.model.se3 import frame_from_normal, quat_from_matrix
from clamber.planning.records import Plan
from clamber.show.framing import seen_points
from clamber.show.marks import FORCE_LENGTH, PHASE_COLOURS
from clamber.show.meshes import Mesh, body_meshes, body_poses, pads_of
from clamber.show.page import paragraphs
from clamber.show.sample import (
    change_at,
    force_by_contact,
    keyframe_times,
    posture_at,
    row_at,
    sample_motion,
    support_polygon_at,
    swings_of,
    thinned,
)
from clamber.show.skeleton import Skeleton
from clamber.step.robust import robust_margin

# One level of meshes, at rest and in motion, that a processor draws in time too.
TRIANGLES, DEVIATION = 15_000, 0.0008  # [m] that faces may be off a round geom
ALIKE, ALIKE_TURNED = 0.004, 0.02  # [m], [rad] that are not seen between two poses
MOST = 3000  # samples of a long run: two minutes at 25 Hz, ten at 5 Hz
GHOST, BEFORE, GHOST_OPACITY = (59, 130, 246), (217, 70, 239), 0.3
SEE_THROUGH = 0.45
BEFORE_EDITING = "before editing"  # the layer of the plan as it was
BALANCE, PUSH, WAY = (37, 99, 235), (162, 28, 175), (124, 58, 237)
PERSON, PERSON_BOX = (144, 172, 201), (203, 188, 165)
DISC, LIFT, LINE = 0.055, 0.004, 0.006  # [m] radius, height, width
BONE, HEAD = 0.03, 0.1  # [m] thickness, radius
ARROW = 2 * FORCE_LENGTH  # [m] of the robot's weight: out of the limb it begins in
LEAST_FORCE = 0.005  # [weights] smaller forces are no arrow
AT_REST = 0.15  # [s] around a keyframe its forces are shown where physics has not run


class Bodies:
    """The bodies of a robot, each a node of which only poses are sent afterwards."""

    def __init__(self, scene: Any, name: str, meshes: Sequence[Mesh], **look: Any):
        """Send the meshes, once: a node for each colour of a body.

        Args:
            scene: To draw in.
            name: Of the node that all hang in.
            meshes: What to draw.
            look: Of all of them; the meshes' own colours by default.
        """
        self.root = scene.add_frame(name, show_axes=False)
        self._frames, self._parts = [], []
        for i, mesh in enumerate(meshes):
            self._frames.append(scene.add_frame(f"{name}/{i}", show_axes=False))
            corners = mesh.colours[mesh.triangles[:, 0]]
            colours, which = np.unique(corners.round(3), axis=0, return_inverse=True)
            for k, colour in enumerate(colours):
                used, faces = np.unique(
                    mesh.triangles[which.ravel() == k], return_inverse=True
                )
                own = {"color": np.round(255 * colour).astype(np.uint8), **look}
                part = scene.add_mesh_simple(
                    f"{name}/{i}/{k}",
                    mesh.vertices[used],
                    faces.reshape(-1, 3),
                    **own,
                )
                self._parts.append(part)

    def pose(self, poses: np.ndarray) -> None:
        """Put the bodies where they are: (nb, 7) position [m] and unit quaternion."""
        for frame, pose in zip(self._frames, poses, strict=True):
            frame.position, frame.wxyz = pose[:3], pose[3:]

    def show(self, which: np.ndarray) -> None:
        """Have only some of them, (nb,) bool, to be seen."""
        for frame, on in zip(self._frames, which.tolist(), strict=True):
            frame.visible = on

    def fade(self, opacity: float | None) -> None:
        """Their opacity, 0 to 1; None: opaque."""
        for part in self._parts:
            part.opacity = opacity


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(nb,) whether bodies with poses (nb, 7) visibly differ from others."""
    cosine = np.minimum(np.abs(np.sum(a[:, 3:] * b[:, 3:], axis=1)), 1.0)
    off = np.linalg.norm(a[:, :3] - b[:, :3], axis=1)
    return (off > ALIKE) | (2 * np.arccos(cosine) > ALIKE_TURNED)


class Ghost:
    """A half-transparent robot, as planned or before editing, where the two differ."""

    def __init__(
        self,
        scene: Any,
        name: str,
        meshes: Sequence[Mesh],
        colour: tuple[int, int, int],
    ):
        """Send it, unseen."""
        look: Mapping[str, Any] = {"color": colour, "opacity": GHOST_OPACITY}
        self._bodies = Bodies(scene, name, meshes, **look)
        self._bodies.root.visible = False

    def show(self, poses: np.ndarray | None, robot: np.ndarray) -> None:
        """Put it at poses (nb, 7), beside those of the robot; None: hide it."""
        self._bodies.root.visible = poses is not None
        if poses is not None:
            self._bodies.pose(poses)
            self._bodies.show(apart(poses, robot))


class Discs:
    """A disc at each of some contacts."""

    def __init__(self, scene: Any, name: str, most: int):
        """Send as many as there may be."""
        self._nodes = [
            scene.add_cylinder(f"{name}/{i}", radius=DISC, height=LIFT, visible=False)
            for i in range(most)
        ]

    def show(
        self, contacts: Sequence[tuple[np.ndarray, Support, tuple[int, int, int]]]
    ) -> None:
        """Put them at points (3,) [m] of their supports, in their colours."""
        for i, node in enumerate(self._nodes):
            node.visible = i < len(contacts)
            if node.visible:
                point, support, colour = contacts[i]
                R = frame_from_normal(support.normal, [1.0, 0.0, 0.0])
                node.position, node.wxyz = point, quat_from_matrix(R)
                node.color = colour


class Stage:
    """The scene of a run, and what changes in it."""

    def __init__(
        self,
        server: Any,
        plan: Plan,
        rollout: Rollout | None,
        root: str,
        *,
        before: Stage | None = None,
    ):
        """Send all that does not change.

        Args:
            server: Whose scene.
            plan: What was to be done.
            rollout: What physics made of it, or None.
            root: Name of the node that all hang in.
            before: Whose robot is shown too on request, as it is at the same time.
        """
        self.motion = m = sample_motion(plan, rollout, {}, MOST)
        self.reached = keyframe_times(plan, rollout)
        self.changes = [f"stance {c.step.stance}: {c.step}" for c in plan.changes]
        as_planned = rollout is None or rollout.followed is None
        trajectory = plan.trajectory if as_planned else None
        self._swings = [] if trajectory is None else swings_of(m, trajectory)
        self._forces = [force_by_contact(plan.world, k) for k in plan.keyframes]
        kin = Kinematics(plan.world)
        self._robust = [robust_margin(kin, k.q, k.stance) for k in plan.keyframes]
        self._kin = Kinematics(m.world)
        self._weight = m.world.mass * 9.81
        add = server.scene
        # Unseen until its bodies are where they belong.
        self.root = add.add_frame(root, show_axes=False, visible=False)
        meshes = body_meshes(
            m.world.model,
            max_triangles=TRIANGLES,
            deviation=DEVIATION,
            pads=pads_of(m.world),
        )
        self._meshes = [x for x in meshes if x.body != 0]
        Bodies(add, f"{root}/scene", [x for x in meshes if x.body == 0])
        self._robot = Bodies(add, f"{root}/robot", self._meshes)
        self._ghost = self._old = None
        self._before = before
        if m.reference is not None:
            self._ghost = Ghost(add, f"{root}/ghost", self._meshes, GHOST)
        if before is not None:
            self._old = Ghost(add, f"{root}/before", self._meshes, BEFORE)
        self._discs = Discs(add, f"{root}/contacts", len(m.world.surfaces))
        none = np.zeros((1, 2, 3))
        self._arrows = add.add_arrows(
            f"{root}/forces",
            none,
            np.zeros((1, 3), dtype=np.uint8),
            shaft_radius=0.009,
            head_radius=0.02,
            head_length=0.045,
        )
        self._balance = add.add_line_segments(
            f"{root}/balance", none, BALANCE, thickness=LINE
        )
        self._com = add.add_icosphere(
            f"{root}/com", radius=0.022, subdivisions=2, color=BALANCE
        )
        self._way = add.add_line_segments(f"{root}/way", none, WAY, thickness=LINE)

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.motion.time[-1])

    def events(self) -> list[float]:
        """Times to step through: contacts made or lost, keyframes, both ends [s]."""
        keys = self.motion.time.tolist() if self.motion.stills else []
        return sorted({0.0, *self.motion.events, *keys, self.duration})

    def show(self, t: float, layers: Mapping[str, bool]) -> str:
        """Send what differs from the last time; figures of this one, as HTML."""
        m, row = self.motion, row_at(self.motion.time, t)
        ghost = old = None
        if self._old is not None and layers[BEFORE_EDITING]:
            assert self._before is not None
            old = self._poses(posture_at(self._before.motion, self._before.motion.q, t))
        if m.reference is not None and layers["planned posture"]:
            ghost = self._poses(posture_at(m, m.reference, t))
        poses = self._poses(posture_at(m, m.q, t))
        for pale, there in ((self._ghost, ghost), (self._old, old)):
            if pale is not None:
                pale.show(there, poses)
        self._robot.pose(poses)
        self.root.visible = True
        self._robot.fade(SEE_THROUGH if layers["transparent robot"] else None)
        supports = list(m.world.supports.values())
        found = [
            (m.points[row, j], supports[m.support[row, j]], PHASE_COLOURS[phase])
            for j in range(len(m.world.surfaces))
            if (phase := m.phase(row, j)) is not None
        ]
        self._discs.show(found if layers["contacts"] else [])
        self._show_arrows(row, t, layers["forces"])
        self._show_balance(row, layers["support polygon"])
        way = next((w for end, w in self._swings if end > t), ())
        self._way.visible = layers["swing path"] and len(way) > 1
        if self._way.visible:
            self._way.points = np.stack([way[:-1], way[1:]], axis=1)
        under_way = change_at(self.changes, self.reached, t)
        facts = [f"{t:.2f} of {self.duration:.1f} s; {under_way}"]
        if t > self.duration:  # beside a longer run
            facts = [f"{t:.2f} s; done after {self.duration:.1f} s"]
        if math.isfinite(m.margin[row]):
            facts.append(f"CoM margin {1000 * m.margin[row]:.0f} mm")
        pairs = zip(self._robust, self.reached, strict=True)
        made = [robust for robust, at in pairs if at is not None and at <= t]
        if made:
            facts.append(f"robust margin {1000 * made[-1]:.0f} mm at the keyframe")
        return paragraphs(facts)

    def seen(self) -> np.ndarray:
        """(n, 3) points that a camera has to have in view [m]."""
        return seen_points(self._kin, self.motion.q)

    def base(self, t: float) -> np.ndarray:
        """(3,) where the robot's base is at a time [s], level with the ground [m]."""
        return posture_at(self.motion, self.motion.q, t)[:3] * [1.0, 1.0, 0.0]

    def _poses(self, q: np.ndarray) -> np.ndarray:
        """(nb, 7) of the bodies at a posture, at which the kinematics stay."""
        self._kin.update(q)
        return body_poses(self._kin.data, self._meshes)

    def _show_arrows(self, row: int, t: float, on: bool) -> None:
        """Forces of physics, else of the keyframe near this time; and the push."""
        m, arrows, colours = self.motion, [], []
        static: Mapping[str, np.ndarray] = {}
        if m.force is None:
            near = 0.5 if m.stills else AT_REST
            for at, forces in zip(self.reached, self._forces, strict=True):
                static = forces if at is not None and abs(at - t) <= near else static
        for j, surface in enumerate(m.world.surfaces):
            force = static.get(surface) if m.force is None else m.force[row, j]
            phase = m.phase(row, j)
            if phase is None or force is None:
                continue
            if np.linalg.norm(force) > LEAST_FORCE * self._weight:
                tail = m.points[row, j]
                arrows.append([tail, tail + ARROW / self._weight * force])
                colours.append(PHASE_COLOURS[phase])
        if m.push is not None and np.any(m.push[row]):
            tip = m.q[row, :3]
            arrows.append([tip - 2 * ARROW / self._weight * m.push[row], tip])
            colours.append(PUSH)
        self._arrows.visible = on and bool(arrows)
        if self._arrows.visible:
            self._arrows.colors = np.array(colours, dtype=np.uint8)
            self._arrows.points = np.array(arrows)

    def _show_balance(self, row: int, on: bool) -> None:
        """The support polygon, at its highest contact, and the CoM over it."""
        polygon = support_polygon_at(self.motion, self._kin, row)
        self._balance.visible = self._com.visible = on and len(polygon) > 1
        if self._com.visible:
            com = self._kin.com.copy()
            foot = np.array([*com[:2], polygon[0, 2]])
            sides = np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)
            self._balance.points = np.concatenate([sides, [[foot, com]]])
            self._com.position = com


class Figure:
    """A person as bones, among their boxes, with their contacts."""

    def __init__(self, server: Any, skeleton: Skeleton, offset: np.ndarray):
        """Send boxes, head and bones.

        Args:
            server: Whose scene.
            skeleton: The recording.
            offset: (3,) where its world is put [m].
        """
        add, self.skeleton, self._offset = server.scene, skeleton, offset
        self.root = add.add_frame("/person", show_axes=False, position=offset)
        for i, box in enumerate(skeleton.demo.scene.boxes):
            add.add_box(
                f"/person/box{i}",
                color=PERSON_BOX,
                dimensions=tuple(box.size),
                wxyz=quat_from_matrix(box.rotation),
                position=box.centre,
            )
        none = np.zeros((1, 2, 3))
        self._bones = add.add_line_segments(
            "/person/bones", none, PERSON, thickness=BONE
        )
        self._head = add.add_icosphere("/person/head", radius=HEAD, color=PERSON)
        self._discs = Discs(add, "/person/contacts", 16)

    def seen(self) -> np.ndarray:
        """(n, 3) points that a camera has to have in view [m]."""
        return thinned(self.skeleton.position, 60).reshape(-1, 3) + self._offset

    def show(self, t: float) -> str:
        """Put the person where it is; bones that were not seen are not shown."""
        skeleton = self.skeleton
        p, seen = skeleton.at(t)
        bones = skeleton.bones[seen[skeleton.bones].all(axis=1)]
        self._bones.visible = len(bones) > 0
        if len(bones):
            self._bones.points = p[bones]
        self._head.visible = skeleton.head is not None
        if skeleton.head is not None:
            self._head.position = p[skeleton.head]
        contacts, scene = skeleton.contacts(t), skeleton.demo.scene
        green = PHASE_COLOURS["supporting"]
        self._discs.show(
            [
                (x.contact.position, scene.support(x.contact.support), green)
                for x in contacts
            ]
        )
        on = ", ".join(f"{x.part} on {x.contact.support}" for x in contacts)
        return paragraphs([f"{t:.2f} s; {on or 'in the air'}"])

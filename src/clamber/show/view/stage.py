"""A `Frame` in the browser: nodes made once, of which only poses are sent afterwards.

Links hang in one another as the bodies do, so that a hinge that turns is one message,
and one that does not is none. What has a changing number of parts (contacts, arrows,
the polygon) is one node each. Where a processor draws, a triangle costs some 2 us a
frame: lines are rods with few faces, and a link of the ghost is there only where it can
be told from the robot's own.

Shapes: nb drawn bodies, nS surfaces, k contacts.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import viser

from clamber.model.se3 import (
    frame_from_normal,
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
)
from clamber.model.world import World
from clamber.show.meshes import Mesh
from clamber.show.pictures import PHASE_COLOURS
from clamber.show.view.person import Figure, Person
from clamber.show.view.shown import (
    ELLIPSE_POINTS,
    Frame,
    Shown,
    Touch,
    apart,
    beams,
    force_arrow,
    tube,
    way_at,
)

GHOST = (59, 130, 246)
PUSH = (162, 28, 175)
BALANCE, ELLIPSE, COM = (37, 99, 235), (8, 145, 178), (217, 70, 239)
WAY, WAY_LINE, WAY_SIDES = (124, 58, 237), 0.007, 8  # width of the line [m]
PERSON, PERSON_BOX = (144, 172, 201), (203, 188, 165)
BONE, JOINT, HEAD = 0.022, 0.03, 0.1  # [m] radii
MOST_PARTS = 16  # of a person that are in contact at once
DISC, DISC_HEIGHT, LIFT = 0.055, 0.004, 0.002  # [m]
CONE_HEIGHT = 0.14  # [m]
SIDES = 16
LINE = 0.006  # [m] width of lines
STILL = 1e-5  # [m], of a quaternion: what moves by less is not sent
MOST_CORNERS = 16  # of a support polygon that are drawn
SEE_THROUGH = 0.6  # opacity of the robot around contacts and forces
LINKS_AROUND = 3  # bodies from a contact upwards that its force may lie in
HIDDEN = 1e-4  # scale of a part of a node that is not there
RECORDING = "recording"
LAYERS = {  # name in the page: shown at first
    "planned posture": True,
    "see-through robot": False,
    "contacts": True,
    "forces": True,
    "friction cones": False,
    "balance": True,
    "way of the limb": True,
    RECORDING: False,
}


def linear(colour: Collection[int]) -> np.ndarray:
    """(3,) uint8: an sRGB colour as nodes of many parts take theirs."""
    c = np.array([*colour]) / 255
    light = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.round(255 * light).astype(np.uint8)


class Links:
    """Bodies that hang in one another."""

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        world: World,
        meshes: Sequence[Mesh],
        *,
        ghost: bool = False,
    ) -> None:
        """Send the meshes, once.

        Args:
            server: Whose scene.
            root: Name of the node that all hang in.
            world: Whose bodies.
            meshes: Of them; the world's own is left out.
            ghost: Pale and see-through.
        """
        self.root = server.scene.add_frame(root, show_axes=False)
        own = [m for m in meshes if m.body != 0]
        self._bodies = [m.body for m in own]
        index = {m.body: i for i, m in enumerate(own)}
        self._rows = np.array([i for i, m in enumerate(meshes) if m.body != 0])
        names: list[str] = []
        parents: list[int] = []
        self._nodes: list[Any] = []
        self._names: list[str] = []
        self._meshes: list[list[Any]] = []
        self._fine: dict[int, list[list[Any]]] = {}  # of browsers that have them
        self._clear: frozenset[int] = frozenset()
        self._shown = np.ones(len(own), dtype=bool)
        for m in own:
            parent = int(world.model.body_parentid[m.body])
            while parent and parent not in index:
                parent = int(world.model.body_parentid[parent])
            parents.append(index.get(parent, -1))
            above = names[parents[-1]] if parents[-1] >= 0 else root
            names.append(f"{above}/{m.body}")
            self._nodes.append(server.scene.add_frame(names[-1], show_axes=False))
            self._names.append(f"{names[-1]}/mesh")
            self._meshes.append(add_mesh(server.scene, self._names[-1], m, ghost=ghost))
        self._parents = np.array(parents, dtype=int)
        self._sent = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(own), 1))

    def see_through(self, bodies: Collection[int]) -> None:
        """Have these let see what is inside of them and behind, and no others."""
        if frozenset(bodies) == self._clear:
            return
        self._clear = frozenset(bodies)
        for meshes in (self._meshes, *self._fine.values()):
            self._tint(meshes)

    def _tint(self, meshes: Sequence[Sequence[Any]]) -> None:
        for body, nodes in zip(self._bodies, meshes, strict=True):
            for node in nodes:
                node.opacity = SEE_THROUGH if body in self._clear else None

    def refine(self, client: viser.ClientHandle, meshes: Sequence[Mesh]) -> None:
        """Have one browser draw other meshes of the same bodies, with shadows."""
        own = (m for m in meshes if m.body != 0)
        fine = self._fine[client.client_id] = [
            add_mesh(client.scene, name, mesh, shadows=True)
            for name, mesh in zip(self._names, own, strict=True)
        ]
        self._tint(fine)

    def coarsen(self, client: viser.ClientHandle) -> None:
        """Have it draw the first ones again."""
        for nodes in self._fine.pop(client.client_id, []):
            for node in nodes:
                node.remove()

    def pose(self, poses: np.ndarray, shown: np.ndarray | None = None) -> None:
        """Put the bodies where they are.

        Args:
            poses: (nb, 7) in the world, of all meshes.
            shown: (nb,) bool, which of them are to be seen; all by default.
        """
        up, wanted = self._parents, np.ones(len(self._rows), dtype=bool)
        if shown is not None:
            wanted = shown[self._rows]
            for i in np.flatnonzero(wanted != self._shown):
                for mesh in self._meshes[i]:
                    mesh.visible = bool(wanted[i])
            self._shown = wanted.copy()
            for i in range(len(up) - 1, -1, -1):  # what it hangs in is to be right too
                if wanted[i] and up[i] >= 0:
                    wanted[up[i]] = True
            if not wanted.any():
                return
        p, q = poses[self._rows, :3], poses[self._rows, 3:]
        inverse = quat_conjugate(q[up])
        turned = quat_multiply(inverse, q)
        moved = np.einsum("nij,nj->ni", matrix_from_quat(inverse), p - p[up])
        turned[up < 0], moved[up < 0] = q[up < 0], p[up < 0]
        now = np.concatenate([moved, turned], axis=1)
        new = (np.abs(now - self._sent) > STILL) & wanted[:, None]
        for i in np.flatnonzero(new[:, :3].any(axis=1)):
            self._nodes[i].position = self._sent[i, :3] = moved[i]
        for i in np.flatnonzero(new[:, 3:].any(axis=1)):
            self._nodes[i].wxyz = self._sent[i, 3:] = turned[i]


def _links_at(world: World, body: int) -> list[int]:
    """A body and those above it up to the next that is drawn, that one included."""
    links = [body]
    while len(links) < LINKS_AROUND and world.model.body_parentid[links[-1]]:
        links.append(int(world.model.body_parentid[links[-1]]))
    return links


def add_mesh(
    scene: viser.SceneApi,
    name: str,
    mesh: Mesh,
    *,
    ghost: bool = False,
    shadows: bool = False,
) -> list[Any]:
    """One node for each colour of a mesh.

    Args:
        scene: Of all browsers, or of one.
        name: Of the node that they hang in.
        mesh: What to draw.
        ghost: Pale and see-through.
        shadows: It casts them, and has them on it.
    """
    nodes = []
    corners = mesh.colours[mesh.triangles[:, 0]]
    colours, which = np.unique(corners.round(3), axis=0, return_inverse=True)
    for i, colour in enumerate(colours):
        faces = mesh.triangles[which.ravel() == i]
        used, at = np.unique(faces, return_inverse=True)
        node = scene.add_mesh_simple(
            f"{name}/{i}",
            mesh.vertices[used],
            at.reshape(-1, 3),
            color=GHOST if ghost else np.round(255 * colour).astype(np.uint8),
            opacity=0.28 if ghost else None,
            cast_shadow=shadows,
            receive_shadow=shadows,
        )
        nodes.append(node)
    return nodes


def _cylinder(radius: float, height: float, top: float) -> tuple[np.ndarray, ...]:
    """Vertices and triangles of a cylinder on z = 0, its upper rim scaled by `top`."""
    a = np.linspace(0.0, 2 * np.pi, SIDES, endpoint=False)
    ring = radius * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    up = np.array([0.0, 0.0, height])
    upper = ring * np.array([top, top, 1.0]) + up
    vertices = np.concatenate([ring, upper, np.zeros((1, 3)), up[None]])
    i, j = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    low, high = np.full(SIDES, 2 * SIDES), np.full(SIDES, 2 * SIDES + 1)
    faces = np.concatenate(
        [
            np.stack([i, j, j + SIDES], 1),
            np.stack([i, j + SIDES, i + SIDES], 1),
            np.stack([low, j, i], 1),
            np.stack([high, i + SIDES, j + SIDES], 1),
        ]
    )
    return vertices, faces


def _round_top(radius: float, height: float) -> tuple[np.ndarray, ...]:
    """Vertices and triangles of what is seen of a flat disc on z = 0: it from above."""
    a = np.linspace(0.0, 2 * np.pi, SIDES, endpoint=False)
    ring = np.stack([radius * np.cos(a), radius * np.sin(a), 0.0 * a + height], axis=1)
    i = np.arange(SIDES)
    faces = np.stack([0 * i + SIDES, i, (i + 1) % SIDES], axis=1)
    return np.concatenate([ring, [[0.0, 0.0, height]]]), faces


class Marks:
    """A mark at each of at most `most` contacts, coloured by phase."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        most: int,
        shape: tuple[np.ndarray, ...],
        *,
        by_friction: bool = False,
        **look: Any,
    ) -> None:
        """Send one mark, of which there are `most`.

        Args:
            server: Whose scene.
            name: Of the node.
            most: Contacts at most.
            shape: Vertices and triangles, the contact's normal along z.
            by_friction: They are as wide as the contact's friction, times their shape.
            look: Of the material.
        """
        vertices, faces = shape
        self._most, self._by_friction = most, by_friction
        self.node = server.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (most, 1)),
            np.zeros((most, 3)),
            batched_scales=np.full((most, 3), HIDDEN),
            batched_colors=np.zeros((most, 3), dtype=np.uint8),
            lod="off",
            cast_shadow=False,
            **look,
        )

    def show(self, touches: Sequence[Touch]) -> None:
        """Put them at the contacts."""
        most = self._most
        p: np.ndarray = np.zeros((most, 3))
        scale: np.ndarray = np.full((most, 3), HIDDEN)
        q = np.tile([1.0, 0.0, 0.0, 0.0], (most, 1))
        colour = np.zeros((most, 3), dtype=np.uint8)
        for i, touch in enumerate(touches[:most]):
            p[i] = touch.position + LIFT * touch.normal
            q[i] = quat_from_matrix(frame_from_normal(touch.normal, [1.0, 0.0, 0.0]))
            wide = touch.friction if self._by_friction else 1.0
            scale[i] = [wide, wide, 1.0]
            colour[i] = linear(PHASE_COLOURS[touch.phase])
        self.node.batched_positions, self.node.batched_wxyzs = p, q
        self.node.batched_scales, self.node.batched_colors = scale, colour


def discs(server: viser.ViserServer, name: str, most: int) -> Marks:
    """Contacts."""
    return Marks(server, name, most, _round_top(DISC, DISC_HEIGHT))


def cones(server: viser.ViserServer, name: str, most: int) -> Marks:
    """Friction cones of contacts: the forces that do not slip lie inside."""
    cone = _cylinder(1e-3, CONE_HEIGHT, CONE_HEIGHT / 1e-3)  # of friction 1
    look: dict[str, Any] = {"opacity": 0.3, "side": "double", "receive_shadow": False}
    return Marks(server, name, most, cone, by_friction=True, **look)


class Balance:
    """Support polygon, its ellipse, the centre of mass and its projection."""

    def __init__(self, server: viser.ViserServer, name: str) -> None:
        """Send what has no shape yet."""
        add = server.scene
        self.root = add.add_frame(name, show_axes=False)
        fan = np.arange(1, MOST_CORNERS - 1)
        self._area = add.add_mesh_simple(
            f"{name}/area",
            np.zeros((MOST_CORNERS, 3)),
            np.stack([0 * fan, fan, fan + 1], axis=1),
            color=BALANCE,
            opacity=0.18,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._rim = Lines(server, f"{name}/rim", MOST_CORNERS, BALANCE)
        self._ring = Lines(server, f"{name}/ring", ELLIPSE_POINTS, ELLIPSE)
        self._drop = Lines(server, f"{name}/drop", 1, COM)
        self._com = add.add_icosphere(
            f"{name}/com", radius=0.022, subdivisions=1, color=COM
        )
        vertices, faces = _round_top(0.018, 0.003)
        self._foot = add.add_mesh_simple(
            f"{name}/foot", vertices, faces, color=COM, cast_shadow=False
        )

    def show(self, frame: Frame) -> None:
        """Draw those of a frame, to the millimetre: what has not moved is not sent."""
        lift = np.array([0.0, 0.0, LIFT])
        polygon, ellipse = frame.polygon.round(3), frame.ellipse.round(3)
        drop = np.stack([frame.foot, frame.com]).round(3)
        rows = np.minimum(np.arange(MOST_CORNERS), len(polygon) - 1)
        self._area.visible = len(polygon) > 2
        if len(polygon) > 2:
            self._area.vertices = polygon[rows] + lift
        self._rim.show(polygon[rows] + 2 * lift if len(polygon) > 1 else polygon)
        self._ring.show(ellipse + 2 * lift)
        self._drop.show(drop)
        self._com.position, self._foot.position = drop[1], drop[0]


class Lines:
    """A ring of a fixed number of lines."""

    def __init__(
        self, server: viser.ViserServer, name: str, count: int, colour: Any
    ) -> None:
        """Send lines without length."""
        vertices, faces = beams(np.zeros((count, 2, 3)), LINE)
        self._node = server.scene.add_mesh_simple(
            name, vertices, faces, color=colour, cast_shadow=False, receive_shadow=False
        )

    def show(self, ring: np.ndarray) -> None:
        """Draw it through points (count, 3), or (2, 3) for one line; none hides it."""
        self._node.visible = len(ring) > 1
        if len(ring) > 1:
            ends = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
            self._node.vertices = beams(ends[: len(ends) - (len(ends) == 2)], LINE)[0]


class Stage:
    """The scene of a run, and what changes in it."""

    def __init__(self, server: viser.ViserServer, shown: Shown, root: str) -> None:
        """Send all that does not change.

        Args:
            server: Whose scene.
            shown: The run.
            root: Name of the node that all hang in.
        """
        world, add = shown.world, server.scene
        self._shown = shown
        self.root = add.add_frame(root, show_axes=False)
        for m in shown.meshes:
            if m.body == 0:
                add_mesh(add, f"{root}/scene", m, shadows=True)
        most = len(world.surfaces)
        self._robot = Links(server, f"{root}/robot", world, shown.meshes)
        self._ghost = None
        if shown.reference is not None:
            self._ghost = Links(
                server, f"{root}/ghost", world, shown.meshes, ghost=True
            )
        self._discs = discs(server, f"{root}/contacts", most)
        self._cones = cones(server, f"{root}/cones", most)
        self._arrows = add.add_arrows(
            f"{root}/forces",
            np.zeros((1, 2, 3)),
            np.zeros((1, 3), dtype=np.uint8),
            shaft_radius=0.009,
            head_radius=0.02,
            head_length=0.045,
        )
        self._balance = Balance(server, f"{root}/balance")
        self._ways = []
        for i, way in enumerate(shown.ways):
            vertices, faces = tube(way.points, way.radius, WAY_SIDES)
            name = f"{root}/way{i}"
            node = add.add_frame(name, show_axes=False, visible=False)
            add.add_mesh_simple(
                f"{name}/margin",
                vertices,
                faces,
                color=WAY,
                opacity=0.16,
                cast_shadow=False,
                receive_shadow=False,
            )
            steps = np.stack([way.points[:-1], way.points[1:]], axis=1)
            line, sides = beams(steps, WAY_LINE)
            add.add_mesh_simple(
                f"{name}/line", line, sides, color=WAY, cast_shadow=False
            )
            self._ways.append(node)
        self._layers: dict[str, bool] = dict(LAYERS)
        self._links = {
            name: frozenset(_links_at(world, surface.body))
            for name, surface in world.surfaces.items()
        }

    def fine(self, client: viser.ClientHandle, on: bool) -> None:
        """Whether a browser draws the robot with all its faces, and shadows."""
        self._robot.coarsen(client)
        if on:
            self._robot.refine(client, self._shown.fine)

    def layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`; what it holds follows with the next frame."""
        self._layers[name] = shown

    def show(self, frame: Frame) -> None:
        """Send what differs from the last frame."""
        on = self._layers
        self._robot.pose(frame.poses)
        self._robot.see_through(self._clear(frame))
        if self._ghost is not None:
            self._ghost.root.visible = on["planned posture"]
            if frame.ghost is not None and on["planned posture"]:
                self._ghost.pose(frame.ghost, apart(frame.ghost, frame.poses))
        self._discs.node.visible = on["contacts"]
        if on["contacts"]:
            self._discs.show(frame.touches)
        self._cones.node.visible = on["friction cones"]
        if on["friction cones"]:
            self._cones.show(frame.touches)
        self._show_forces(frame)
        self._balance.root.visible = on["balance"]
        if on["balance"]:
            self._balance.show(frame)
        way = way_at(self._shown, frame.time) if on["way of the limb"] else None
        for node, its in zip(self._ways, self._shown.ways, strict=True):
            node.visible = its is way

    def _clear(self, frame: Frame) -> frozenset[int]:
        """Bodies that would hide what is shown: all, or those around the forces."""
        if self._layers["see-through robot"]:
            return frozenset(range(self._shown.world.model.nbody))
        if not self._layers["forces"]:
            return frozenset()
        pushed = [x.surface for x in frame.touches if x.force is not None]
        return frozenset().union(*(self._links[name] for name in pushed))

    def _show_forces(self, frame: Frame) -> None:
        arrows, colours = [], []
        for touch in frame.touches:
            arrow = force_arrow(self._shown.world, touch)
            if arrow is not None:
                arrows.append(arrow)
                colours.append(linear(PHASE_COLOURS[touch.phase]))
        if frame.push is not None:
            arrows.append(frame.push)
            colours.append(linear(PUSH))
        self._arrows.visible = bool(arrows) and self._layers["forces"]
        if self._arrows.visible:
            self._arrows.colors = np.array(colours, dtype=np.uint8)
            self._arrows.points = np.array(arrows)


class Stick:
    """A person as bones and joints, among its boxes, with its contacts."""

    def __init__(self, server: viser.ViserServer, person: Person, root: str) -> None:
        """Send boxes, a bone and a joint.

        Args:
            server: Whose scene.
            person: The recording.
            root: Name of the node that all hang in.
        """
        add = server.scene
        self._person = person
        self.root = add.add_frame(root, show_axes=False)
        for i, box in enumerate(person.demo.scene.boxes):
            add.add_box(
                f"{root}/box{i}",
                color=PERSON_BOX,
                dimensions=tuple(box.size),
                wxyz=quat_from_matrix(box.rotation),
                position=box.position + person.offset,
            )
        count, joints = len(person.bones), len(person.joints)
        vertices, faces = _cylinder(BONE, 1.0, 1.0)
        common: dict[str, Any] = {"lod": "off", "cast_shadow": True}
        self._bones = add.add_batched_meshes_simple(
            f"{root}/bones",
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            np.zeros((count, 3)),
            batched_scales=np.ones((count, 3)),
            batched_colors=linear(PERSON),
            **common,
        )
        ball, triangles = tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2e-6]]), JOINT)
        self._head = None
        if "Head" in person.demo.names:  # the last of the joints
            self._head = add.add_icosphere(
                f"{root}/head", radius=HEAD, subdivisions=2, color=PERSON
            )
        self._joints = add.add_batched_meshes_simple(
            f"{root}/joints",
            ball,
            triangles,
            np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1)),
            np.zeros((joints, 3)),
            batched_scales=np.ones(joints),
            batched_colors=linear(PERSON),
            **common,
        )
        self._discs = discs(server, f"{root}/contacts", MOST_PARTS)

    def show(self, figure: Figure) -> None:
        """Put the person where it is; bones that were not seen are not shown."""
        a, way = figure.bones[:, 0], figure.bones[:, 1] - figure.bones[:, 0]
        length = np.linalg.norm(way, axis=1)
        self._bones.batched_positions = a
        self._bones.batched_wxyzs = np.array(
            [
                quat_from_matrix(frame_from_normal(d / max(l, 1e-9), [1.0, 0.0, 0.0]))
                for d, l in zip(way, length, strict=True)
            ]
        )
        scale = np.stack([np.ones_like(length)] * 2 + [length], axis=1)
        scale[~figure.seen] = HIDDEN
        self._bones.batched_scales = scale
        self._joints.batched_positions = figure.joints
        if self._head is not None:
            self._head.position = figure.joints[-1]
        self._discs.show(figure.touches)

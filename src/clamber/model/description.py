"""MJCF or URDF file -> MuJoCo's spec, read with care.

What a description names is looked for and only read; nothing is written. A URDF's
`package://` meshes are found beside the file and in `ROS_PACKAGE_PATH`; those that
MuJoCo does not load become part of the spec.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from clamber.errors import InputError
from clamber.model.markup import read_xml
from clamber.model.mesh_files import COLLADA, MeshFile, read_mesh
from clamber.model.se3 import matrix_from_quat

MESHES = (".stl", ".obj", ".msh", COLLADA)
CLEARLY = 0.5  # times as far, and no farther, are joints from what is theirs
WATER = 1000.0  # [kg/m^3]
LEAST_INERTIA = 1e-9  # [kg m^2]
PACKAGE = "package://"
SEARCH_PATH = "ROS_PACKAGE_PATH"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Description:
    """A description as MuJoCo's spec, and what was left out of it.

    Attributes:
        spec: Not compiled.
        mimics: Joint that follows, by joint (URDF's `mimic`, MJCF's joint couplings).
        notes: For people.
    """

    spec: mujoco.MjSpec
    mimics: dict[str, str]
    notes: tuple[str, ...] = ()


def read_description(path: Path, *, lenient: bool = False) -> Description:
    """Read an MJCF or URDF file.

    Args:
        path: The file.
        lenient: Mend with a note what would be an error: leave out meshes of unknown
            formats, give links without a proper inertia a small one.

    Raises:
        InputError: It cannot be read, is no such file, or a mesh is missing or broken.
    """
    root = read_xml(path)
    notes: list[str] = []
    try:
        if root.tag == "robot":
            mimics = {
                str(j.get("name")): str(m.get("joint"))
                for j in root.findall("joint")
                for m in j.findall("mimic")
            }
            _resolve_meshes(root, path, lenient, notes)
            _check_inertia(root, path, lenient, notes)
            _keep_all(root)
            text = ElementTree.tostring(root, encoding="unicode")
            spec = mujoco.MjSpec.from_string(text)
            _take_meshes(spec, notes)
        elif root.tag in ("mujoco", "mujocoinclude"):
            spec = mujoco.MjSpec.from_file(str(path))
            mimics = {
                str(e.name1): str(e.name2)
                for e in spec.equalities
                if e.type == mujoco.mjtEq.mjEQ_JOINT
            }
        else:
            raise InputError(
                "an MJCF (mujoco) or URDF (robot) file", source=path, value=root.tag
            )
    except ValueError as e:
        raise InputError(
            f"a model that MuJoCo loads ({_one_line(e)})", source=path
        ) from e
    return Description(spec=spec, mimics=mimics, notes=tuple(notes))


def compile_description(description: Description, path: Path) -> mujoco.MjModel:
    """Compile.

    Raises:
        InputError: MuJoCo's reason, such as a mesh that is missing.
    """
    try:
        return description.spec.compile()
    except ValueError as e:
        raise InputError(
            f"a model that MuJoCo loads ({_one_line(e)})", source=path
        ) from e


def _one_line(e: Exception) -> str:
    return " ".join(str(e).split())


def _resolve_meshes(
    root: ElementTree.Element, path: Path, lenient: bool, notes: list[str]
) -> None:
    """Put where a mesh is in place of what it is called."""
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                mesh = shape.find("geometry/mesh")
                if mesh is None:
                    continue
                name = mesh.get("filename", "")
                where = f"link {link.get('name')!r}: {kind} mesh"
                if Path(name).suffix.lower() not in MESHES:
                    if not lenient:
                        raise InputError(
                            f"one of {', '.join(MESHES)}",
                            source=path,
                            field=where,
                            value=name,
                        )
                    link.remove(shape)
                    notes.append(f"{where} {name} is left out: no known format")
                    continue
                found = next((p for p in _places(name, path) if p.is_file()), None)
                if found is None:
                    hint = f", or its package below {SEARCH_PATH}"
                    raise InputError(
                        "a mesh that is there" + (hint if PACKAGE in name else ""),
                        source=path,
                        field=where,
                        value=name,
                    )
                mesh.set("filename", str(found.resolve()))


def _take_meshes(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Put the triangles of files that MuJoCo does not load into the spec."""
    read = {m.name: read_mesh(Path(m.file)) for m in spec.meshes}
    found = {n: m for n, m in read.items() if m is not None}
    upright = _fits_upright(spec, found)
    if upright:
        notes.append(
            "the up axis of its COLLADA meshes is heeded: ignored, as RViz does, they"
            " do not reach their joints"
        )
    for mesh in spec.meshes:
        if mesh.name in found:
            file = found[mesh.name]
            vertices = file.vertices @ file.upright.T if upright else file.vertices
            mesh.file = ""
            mesh.uservert, mesh.userface = vertices.ravel(), file.triangles.ravel()


def _fits_upright(spec: mujoco.MjSpec, meshes: Mapping[str, MeshFile]) -> bool:
    """Whether a description expects that the up axis of COLLADA files is heeded.

    RViz and Gazebo ignore it, Bullet heeds it, and people write for what they use. The
    joints of a link tell: they are within its meshes or near them. Sums up how far
    each is from the box around each mesh, with the axis ignored and heeded.
    """
    off = np.zeros(2)
    for geom in spec.geoms:
        file = meshes.get(geom.meshname)
        if file is None:
            continue
        scale, R = spec.mesh(geom.meshname).scale, matrix_from_quat(geom.quat)
        for i, turn in enumerate((np.eye(3), file.upright)):
            vertices = file.vertices @ turn.T * scale
            for child in geom.parent.bodies:
                p = R.T @ (child.pos - geom.pos)
                beside = np.maximum(vertices.min(axis=0) - p, p - vertices.max(axis=0))
                off[i] += float(np.linalg.norm(np.maximum(beside, 0.0)))
    return bool(off[1] < CLEARLY * off[0])


def _check_inertia(
    root: ElementTree.Element, path: Path, lenient: bool, notes: list[str]
) -> None:
    """What has mass must have a positive inertia."""
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        try:
            mass = float(inertial.find("mass").get("value"))  # pyright: ignore
            I = {k: float(v) for k, v in inertial.find("inertia").items()}  # pyright: ignore
            full = [
                [I["ixx"], I["ixy"], I["ixz"]],
                [I["ixy"], I["iyy"], I["iyz"]],
                [I["ixz"], I["iyz"], I["izz"]],
            ]
        except (AttributeError, KeyError, TypeError, ValueError) as e:
            raise InputError(
                "a mass and an inertia in numbers",
                source=path,
                field=f"link {link.get('name')!r}: inertial",
            ) from e
        if mass > 0 and np.linalg.eigvalsh(np.array(full))[0] > LEAST_INERTIA:
            continue
        where = f"link {link.get('name')!r}: inertia"
        if mass <= 0:
            link.remove(inertial)
            continue
        if not lenient:
            raise InputError("a positive inertia", source=path, field=where)
        notes.append(f"{where} is not positive: that of a ball as dense as water")
        radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
        ball = f"{0.4 * mass * radius**2:.6g}"
        element = inertial.find("inertia")
        assert element is not None
        element.attrib.update(ixx=ball, iyy=ball, izz=ball, ixy="0", ixz="0", iyz="0")


def _keep_all(root: ElementTree.Element) -> None:
    """Ask MuJoCo to keep what it would drop: the root's mass, what is only seen."""
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.set("strippath", "false")
    compiler.set("discardvisual", "false")
    compiler.set("fusestatic", "false")
    compiler.set("balanceinertia", "true")


def _places(name: str, path: Path) -> Iterator[Path]:
    """Where a mesh of a URDF may be, the likeliest first."""
    if not name.startswith(PACKAGE):
        plain = name.removeprefix("file://")
        yield path.parent / plain
        return
    rest = name.removeprefix(PACKAGE).lstrip("/")
    inside = rest.partition("/")[2]
    for folder in path.resolve().parents:
        yield folder / rest
        if folder.name == rest.partition("/")[0]:
            yield folder / inside
    for folder in os.environ.get(SEARCH_PATH, "").split(os.pathsep):
        if folder:
            yield Path(folder) / rest
            if Path(folder).name == rest.partition("/")[0]:
                yield Path(folder) / inside

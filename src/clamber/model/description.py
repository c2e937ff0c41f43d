"""MJCF or URDF file -> MuJoCo's spec, with checks and fallbacks.

What a description names is looked for and only read; nothing is written. A URDF's
`package://` meshes are found beside the file and in `ROS_PACKAGE_PATH`; those that
MuJoCo does not load become part of the spec.

Shapes: N vertices, F triangles.
"""

from __future__ import annotations

import functools
import io
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from clamber.errors import InputError, check_kind, in_its_place, unreadable
from clamber.model.records import short_repr
from clamber.model.se3 import matrix_from_quat

COLLADA, STL = ".dae", ".stl"
MESHES = (STL, ".obj", ".msh", COLLADA)
CLEARLY = 0.5  # times as far, and no farther, are joints from what is theirs
WATER = 1000.0  # [kg/m^3]
LEAST_INERTIA = 1e-9  # [kg m^2]
PACKAGES = ("package://", "model://")
SEARCH_PATH = "ROS_PACKAGE_PATH"
MAX_BYTES = 50_000_000  # of a file
MAX_FACES = 200_000  # of a mesh that MuJoCo loads
DETAIL = 2e-3  # [m] nearer vertices of visual meshes are merged
STL_HEAD, STL_FACE = 84, 50  # [byte] of an STL that is not text
# What a shape does not need; the rest of a COLLADA file need not be in order.
_BESIDE = (
    "library_images library_effects library_materials library_cameras library_lights"
    " library_animations library_controllers bind_material instance_camera"
    " instance_light extra"
).split()
# The way right, in and up of a COLLADA file to x, -y and z.
_UPRIGHT = {
    "X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y_UP": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z_UP": np.eye(3),
}


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

    __repr__ = short_repr


def read_description(path: Path, *, lenient: bool = False) -> Description:
    """Read an MJCF or URDF file.

    Args:
        path: The file.
        lenient: Mend with a note what would be an error: leave out meshes of unknown
            formats and shapes without a size, give links without a proper inertia a
            small one. What is only seen and is not there is left out in any case.

    Raises:
        InputError: It cannot be read, is no such file, or a mesh is missing or broken.
    """
    root = read_xml(path)
    notes: list[str] = []
    try:
        if root.tag == "robot":
            _without_macros(root, path, notes)
            mimics = {
                str(j.get("name")): str(m.get("joint"))
                for j in root.findall("joint")
                for m in j.findall("mimic")
            }
            _resolve_meshes(root, path, lenient, notes)
            _check_inertia(root, path, lenient, notes)
            _without_repeats(root)
            _keep_all(root)
            _check_numbers(root, path)
            text = ElementTree.tostring(root, encoding="unicode")
            spec = mujoco.MjSpec.from_string(text)
        elif root.tag in ("mujoco", "mujocoinclude"):
            _check_numbers(root, path)
            spec = _read_mjcf(root, path, notes)
            mimics = {
                str(e.name1): str(e.name2)
                for e in spec.equalities
                if e.type == mujoco.mjtEq.mjEQ_JOINT
            }
        else:
            expected = "an MJCF (mujoco) or URDF (robot) file"
            raise InputError(expected, path, value=root.tag)
        _leave_out_looks(spec, path, notes)
        if lenient:
            _leave_out_sizeless(spec, notes)
        _take_meshes(spec, path, notes)
    except ValueError as e:
        raise InputError(f"a model that MuJoCo loads ({_one_line(e)})", path) from e
    return Description(spec=spec, mimics=mimics, notes=tuple(notes))


def _without_macros(root: ElementTree.Element, path: Path, notes: list[str]) -> None:
    """Leave out what xacro left of macros that nothing defines.

    Raises:
        InputError: There is something that xacro would expand.
    """
    macros = {e for e in root.iter() if "wiki/xacro}" in e.tag}
    names = [e.tag.rpartition("}")[2] for e in macros]
    values = (v for e in root.iter() for v in e.attrib.values())
    defined = {"include", "macro", "property", "arg", "if", "unless", "insert_block"}
    missing = macros and root.find("link") is None
    if missing or defined & {*names} or any("${" in v for v in values):
        expected = "a URDF: expand the macros with `xacro FILE > FILE.urdf`"
        raise InputError(expected, path)
    for parent in list(root.iter()):
        parent[:] = [e for e in parent if e not in macros]
    if names:
        said = ", ".join(sorted({*names}))
        notes.append(f"macros that the file does not define are left out: {said}")


def _read_mjcf(
    root: ElementTree.Element, path: Path, notes: list[str]
) -> mujoco.MjSpec:
    """As MuJoCo reads it; commas between numbers, which older ones took, are blanks."""
    with_commas = {
        (e, name)
        for e in root.iter()
        for name, value in e.attrib.items()
        if "," in value and re.fullmatch(r"[\s\d.,eE+-]+", value)
    }
    if not with_commas or root.find(".//include") is not None:
        return mujoco.MjSpec.from_file(str(path))
    for e, name in with_commas:
        e.set(name, e.attrib[name].replace(",", " "))
    notes.append("commas between numbers are taken for blanks")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(path.parent)
    return spec


def _check_numbers(root: ElementTree.Element, path: Path) -> None:
    """Refuse NaN, of which MuJoCo prints a warning of its own.

    Raises:
        InputError: There is one.
    """
    for e in root.iter():
        for name, value in e.attrib.items():
            if name != "name" and "nan" in value.lower().split():
                raise InputError("numbers", path, f"{e.tag} {name}", value)


def compile_description(description: Description, path: Path) -> mujoco.MjModel:
    """Compile; meshes without a volume, or not closed, count as shells.

    Raises:
        InputError: MuJoCo's reason, such as a mesh that is missing.
    """
    spec = description.spec
    try:
        try:
            return spec.compile()
        except ValueError as e:
            if "mesh" not in str(e) or "inertia" not in str(e):
                raise
            for mesh in spec.meshes:
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            return spec.compile()
    except ValueError as e:
        raise InputError(f"a model that MuJoCo loads ({_one_line(e)})", path) from e


def _one_line(e: Exception) -> str:
    return " ".join(str(e).split()) or type(e).__name__


def _resolve_meshes(
    root: ElementTree.Element, path: Path, lenient: bool, notes: list[str]
) -> None:
    """Resolve mesh URIs to the paths of their files."""
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            where = f"link {link.get('name')!r}: {shape.tag} mesh"
            if Path(name).suffix.lower() not in MESHES:
                if not lenient:
                    raise InputError(f"one of {', '.join(MESHES)}", path, where, name)
                link.remove(shape)
                notes.append(f"{where} {name} is left out: no known format")
                continue
            found = next((p for p in _places(name, path) if p.is_file()), None)
            fault = "is not there" if found is None else _fault(found)
            if fault and shape.tag == "visual":
                link.remove(shape)
                notes.append(f"{where} {name} is left out: it {fault}")
            elif found is None:
                hint = f", or its package below {SEARCH_PATH}"
                expected = "a mesh that is there" + (hint if "://" in name else "")
                raise InputError(expected, path, where, name)
            elif fault:
                raise InputError(f"a mesh (it {fault})", path, where, name)
            else:
                mesh.set("filename", str(found.resolve()))


def _without_repeats(root: ElementTree.Element) -> None:
    """Keep the first of a shape's materials, and of shapes' names.

    MuJoCo takes no second material, and warns of a name that comes again.
    """
    names = set()
    for shape in [*root.iter("visual"), *root.iter("collision")]:
        for material in shape.findall("material")[1:]:
            shape.remove(material)
        if shape.get("name") in names:
            shape.attrib.pop("name")
        names |= {shape.get("name")} - {None}


def _fault(mesh: Path) -> str | None:
    """Why a file cannot be a mesh; None where it may be one."""
    try:
        with mesh.open("rb") as f:
            head = f.read(256)
    except OSError as e:
        return f"cannot be read ({e.strerror})"
    if other := in_its_place(head, "xml"):
        return f"is {other}"
    return None if head.strip() else "is empty"


def _leave_out_looks(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> None:
    """Remove textures, and visual geometry whose file is missing."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in spec.textures:
        spec.delete(texture)
    for mesh in [m for m in spec.meshes if m.file]:
        file = _mesh_path(spec, mesh, path)
        fault = "is not there" if file is None else _fault(file)
        if not fault:
            continue
        shapes = [g for g in spec.geoms if g.meshname == mesh.name]
        links = ", ".join(dict.fromkeys(repr(g.parent.name) for g in shapes))
        if any(g.contype or g.conaffinity for g in shapes):
            where = f"link {links}: collision mesh"
            raise InputError(f"a mesh (it {fault})", path, where, mesh.file)
        for g in shapes:
            spec.delete(g)
        spec.delete(mesh)
        who = f"visual geometry of {links}" if links else f"mesh {mesh.name!r}"
        notes.append(f"{who} is left out: {mesh.file} {fault}")


def _mesh_path(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh, path: Path) -> Path | None:
    """Path of a mesh file, searched for as MuJoCo does; None if it is missing."""
    name = Path(mesh.file)
    places = [path.parent / spec.meshdir / name, path.parent / spec.meshdir / name.name]
    return next((p for p in [*places, path.parent / name] if p.is_file()), None)


def _leave_out_sizeless(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Remove balls, capsules and boxes whose size is 0: markers, no shapes."""
    kinds = mujoco.mjtGeom
    needed = {kinds.mjGEOM_BOX: 3, kinds.mjGEOM_ELLIPSOID: 3}
    solid = (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER, *needed)
    for g in list(spec.geoms):
        if g.type in solid and not np.all(g.size[: needed.get(g.type, 1)] > 0):
            notes.append(f"link {g.parent.name!r}: a shape of size 0 is left out")
            spec.delete(g)


def _take_meshes(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> None:
    """Put the triangles of files that MuJoCo does not load into the spec."""
    places = {m.name: _mesh_path(spec, m, path) for m in spec.meshes if m.file}
    files = {n: p for n, p in places.items() if p and not _is_for_mujoco(p)}
    found = {n: read_mesh(p) for n, p in files.items()}
    upright = _fits_upright(spec, found)
    if upright:
        notes.append(
            "the up axis of its COLLADA meshes is applied: ignored, as RViz does, they"
            " do not reach their joints"
        )
    for mesh in spec.meshes:
        if mesh.name in found:
            file = found[mesh.name]
            vertices = file.vertices @ file.upright.T if upright else file.vertices
            triangles = file.triangles
            if len(triangles) > MAX_FACES:
                corners = coarser(vertices * mesh.scale, triangles, MAX_FACES)
                vertices, triangles = np.unique(
                    corners.reshape(-1, 3) / mesh.scale, axis=0, return_inverse=True
                )
                links = {g.parent.name for g in spec.geoms if g.meshname == mesh.name}
                notes.append(
                    f"{files[mesh.name].name} of {', '.join(sorted(links))} is coarser:"
                    f" it has {len(file.triangles)} faces, of which {MAX_FACES} are"
                    " taken at most"
                )
            mesh.file = ""
            mesh.uservert, mesh.userface = vertices.ravel(), triangles.ravel()


def coarser(vertices: np.ndarray, faces: np.ndarray, most: int) -> np.ndarray:
    """(F, 3, 3) corners of triangles, on a grid that leaves few enough of them."""
    step = DETAIL
    while True:
        grid = np.round(vertices / step).astype(int)
        _, which, of = np.unique(grid, axis=0, return_index=True, return_inverse=True)
        a, b, c = of.reshape(-1)[faces].T
        kept = faces[(a != b) & (b != c) & (c != a)]
        if len(kept) <= most:
            return vertices[which[of.reshape(-1)[kept]]]
        step *= 2.0


def _fits_upright(spec: mujoco.MjSpec, meshes: Mapping[str, MeshFile]) -> bool:
    """Whether a description expects the up axis of COLLADA files to be applied.

    RViz and Gazebo ignore it, Bullet applies it, and people write for what they use.
    The joints of a link tell: they are within its meshes or near them. Sums up how far
    each is from the box around each mesh, with the axis ignored and applied.
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
    """Check that links with mass have a positive inertia."""
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        where = f"link {link.get('name')!r}: inertia"
        try:
            mass = float(inertial.find("mass").get("value"))  # pyright: ignore
            I = {k: float(v) for k, v in inertial.find("inertia").items()}  # pyright: ignore
            full = [[I[f"i{min(a, b)}{max(a, b)}"] for b in "xyz"] for a in "xyz"]
        except (AttributeError, KeyError, TypeError, ValueError) as e:
            raise InputError("a mass and an inertia in numbers", path, where) from e
        if mass > 0 and np.linalg.eigvalsh(np.array(full))[0] > LEAST_INERTIA:
            continue
        if mass <= 0:
            link.remove(inertial)
            continue
        if not lenient:
            raise InputError("a positive inertia", path, where)
        notes.append(f"{where} is not positive: that of a ball as dense as water")
        radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
        ball = f"{0.4 * mass * radius**2:.6g}"
        element = inertial.find("inertia")
        assert element is not None
        element.attrib.update(ixx=ball, iyy=ball, izz=ball, ixy="0", ixz="0", iyz="0")


def _keep_all(root: ElementTree.Element) -> None:
    """Ask MuJoCo to keep what it would drop: the root's mass, visual geometry."""
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
    """Candidate paths of a URDF's mesh, the likeliest first."""
    scheme = next((x for x in PACKAGES if name.startswith(x)), None)
    if scheme is None:
        yield path.parent / name.removeprefix("file://")
        return
    rest = name.removeprefix(scheme).lstrip("/")
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
    if "/" in inside:  # the folder of the package has another name
        for folder in path.resolve().parents[:3]:
            yield folder / inside


# Meshes.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class MeshFile:
    """Vertices and faces of a mesh file, in its own axes.

    Attributes:
        vertices: (N, 3) [m].
        triangles: (F, 3) indices of vertices.
        upright: (3, 3) rotation that makes z of the axis that the file calls up; tools
            differ in whether they heed it.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    upright: np.ndarray

    __repr__ = short_repr


def read_mesh(path: Path) -> MeshFile:
    """The triangles of an STL, OBJ or COLLADA file; nothing that it refers to is read.

    COLLADA is placed by the nodes of its scene, in metres; other files are as they are.

    Raises:
        InputError: It cannot be read, or is broken or too large.
    """
    corners, _, upright = read_shapes(path)
    if not np.isfinite(corners).all():
        raise InputError("a mesh of finite numbers", path)
    vertices, faces = np.unique(
        corners.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True
    )
    faces = faces.reshape(-1, 3)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if len(faces) == 0:
        raise InputError("a mesh with triangles", path)
    return MeshFile(vertices=vertices.astype(float), triangles=faces, upright=upright)


def read_shapes(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raw contents of a mesh file, which may include NaN.

    Returns:
        Corners (F, 3, 3) of triangles and points (N, 3) that are of none, in metres or
        the file's own unit, and the turn to z up, see `MeshFile`.

    Raises:
        InputError: It cannot be read, or is broken or too large.
    """
    kind, scale, upright = path.suffix.lower().removeprefix("."), 1.0, np.eye(3)
    try:
        if path.suffix.lower() == COLLADA:
            content, scale, upright = _shapes_of_collada(read_xml(path), path)
        else:
            content = _read_content(path)
            kind = "stl_ascii" if kind == "stl" and _is_text(path) else kind
        import trimesh  # slow to import, and few need it

        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # What is no number would end a list of numbers, with a warning.
            warnings.filterwarnings("error", message=".*string or file could not be")
            scene = trimesh.load_scene(
                io.BytesIO(content),
                file_type=kind,
                process=False,
                ignore_broken=False,
                skip_materials=True,
            )
            clouds = [
                np.asarray(g.vertices)
                for g in scene.geometry.values()
                if isinstance(g, trimesh.PointCloud)
            ]
            points = np.concatenate([np.zeros((0, 3)), *clouds])
            if clouds and len(clouds) == len(scene.geometry):
                return np.zeros((0, 3, 3)), points, upright
            triangles = np.asarray(scene.to_mesh().triangles)
            corners = scale * triangles.reshape(-1, 3, 3)  # (0, 3) where there is none
    except InputError:
        raise
    except Exception as e:  # the libraries raise whatever they trip over
        raise InputError(f"a {path.suffix} mesh ({_one_line(e)})", path) from e
    return corners, points, upright


def _is_for_mujoco(path: Path) -> bool:
    """Whether MuJoCo loads a mesh itself: all but COLLADA, text and large STL."""
    suffix = path.suffix.lower()
    if suffix == STL:
        many = path.stat().st_size > STL_HEAD + STL_FACE * MAX_FACES
        return not many and not _is_text(path)
    return suffix != COLLADA


def _is_text(path: Path) -> bool:
    """Whether an STL is text: a binary one may begin with the same word."""
    content = _read_content(path)
    faces = int.from_bytes(content[80:STL_HEAD], "little")
    binary = len(content) == STL_HEAD + STL_FACE * faces
    return content.lstrip().startswith(b"solid") and not binary


def _shapes_of_collada(
    root: ElementTree.Element, path: Path
) -> tuple[bytes, float, np.ndarray]:
    """A COLLADA file without what is no shape, its unit [m], and the turn to z up.

    What the library would read as something else is refused.
    """
    unit, up, scene = 1.0, "Y_UP", None
    for parent in root.iter():
        for child in list(parent):
            if _tag(child) in _BESIDE:
                parent.remove(child)
        numbers = (parent.text or "").lower()
        if _tag(parent) == "float_array" and "nan" in numbers:
            raise InputError("a mesh of finite numbers", path)
        if _tag(parent) == "p" and "-" in numbers:
            raise InputError("indices of vertices from 0", path)
        if _tag(parent) == "unit":
            unit = float(parent.get("meter", 1.0))
        elif _tag(parent) == "up_axis":
            up = numbers.strip().upper()
        elif _tag(parent) == "scene":
            scene = parent
    if scene is None:
        raise InputError("COLLADA with a scene", path)
    if not 0 < unit < np.inf:
        raise InputError("a positive number", path, "<unit meter>", unit)
    if _written_out(root, scene) > MAX_BYTES:
        what = f"at most {MAX_BYTES // 1_000_000} MB where its nodes are placed"
        raise InputError(what, path)
    return ElementTree.tostring(root), unit, _UPRIGHT[up]


def _tag(element: ElementTree.Element) -> str:
    """Without its namespace."""
    return element.tag.rpartition("}")[2]


def _written_out(root: ElementTree.Element, scene: ElementTree.Element) -> int:
    """Length of a scene with all of its references expanded.

    Nodes that name one another can multiply without end.
    """
    named = {f"#{e.get('id')}": e for e in root.iter()}

    @functools.cache
    def size(e: ElementTree.Element) -> int:
        inside = sum(map(size, e)) + len(e.text or "") + 1
        url = e.get("url")
        return inside + size(named[url]) if url in named else inside

    return size(scene)


# XML.


def _read_content(path: Path) -> bytes:
    """The bytes of a file that is not too large."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"at most {MAX_BYTES // 1_000_000} MB", path, value=size)
        return path.read_bytes()
    except OSError as e:
        raise unreadable(path, e) from e


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file in UTF-8 without a document type.

    A document type could hold entities that expand without end or pull in files.

    Raises:
        InputError: It is no such file, or too large.
    """
    check_kind(path, "XML", "xml")
    content = _read_content(path)
    if b"\0" in content:  # UTF-16 would hide what is looked for next
        raise InputError("XML in UTF-8", path)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        expected = "XML without a document type: entities are not expanded"
        raise InputError(expected, path, "<!DOCTYPE>")
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as e:  # or an encoding
        raise InputError(f"XML ({e})", path) from e

"""Errors, as status values and as exceptions.

A user's mistake is an `InputError` that names file, field, value and what was
expected; a file that people write is read by `read_yaml` and checked by `validated`,
which raise it. A problem without a solution is a `Status`. A missing optional package
is a `MissingDependency` with the line that gets it.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


class ClamberError(Exception):
    """Base of every exception that clamber raises on purpose."""


class InputError(ClamberError):
    """The input cannot be used as it is.

    Args:
        expected: What would have been right, in words.
        source: The file, or the command-line flag, that holds the value.
        field: The field within it, dotted.
        value: The value found.
    """

    def __init__(
        self,
        expected: str,
        source: object = None,
        field: str | None = None,
        value: object = None,
    ) -> None:
        """Compose the sentence."""
        self.expected, self.source = expected, source
        self.field, self.value = field, value
        names = (str(x) for x in (source, field) if x is not None)
        where = ": ".join(x if x.isprintable() else repr(x) for x in names)
        what = ":" if value is None else f" is {value!r};"
        sentence = f"{where}{what} expected {expected}" if where else expected
        super().__init__(sentence)


def unreadable(
    path: object, error: OSError, then: str = "check the path"
) -> InputError:
    """A file that cannot be opened, why, and what to do then."""
    why = error.strerror or "unreadable"
    return InputError(f"a readable file ({why}); {then}", path)


class WrongType(InputError, TypeError):
    """An argument is of another kind than its function takes."""

    def __init__(
        self, function: str, field: str, kinds: Sequence[str], value: object
    ) -> None:
        """Compose the sentence, with what makes the one of the other.

        Args:
            function: Its name.
            field: Name of the argument.
            kinds: That it takes, such as `Plan`.
            value: The value given.
        """
        given = "path" if isinstance(value, str | Path) else type(value).__name__
        takes = " or ".join(f"{'an' if k[0] in 'AEIO' else 'a'} {k}" for k in kinds)
        text = f"{function}() takes {takes} as {field}, got {type(value).__name__}"
        made = [_MADE_BY[given, k] for k in kinds if (given, k) in _MADE_BY]
        super().__init__(f"{text}: did you mean {made[0]}?" if made else text)
        self.field, self.value = field, value


_MADE_BY = {  # what there is, what is wanted: what makes the one of the other
    ("path", "ContactSequence"): "load_sequence(...)",
    ("path", "Demonstration"): "load_demo(...)",
    ("path", "GeneralPolicy"): "load_policy(...)",
    ("path", "Plan"): "load_plan(...)",
    ("path", "Rollout"): "load_rollout(...)",
    ("path", "Spec"): "load_spec(...)",
    ("Demonstration", "ContactSequence"): "detect_contacts(...)",
    ("ContactSequence", "Plan"): "plan(...)",
    ("Plan", "Rollout"): "simulate(...)",
    ("Ranked", "Plan"): "its .plan",
    ("Replanned", "Plan"): "its .best.plan",
}


class MissingDependency(ClamberError):
    """An optional package is absent."""

    def __init__(self, package: str, extra: str) -> None:
        """Name the package and the extra that brings it."""
        self.package = package
        super().__init__(
            f"{package} is not installed: pip install 'clamber[{extra}]' brings it"
        )


class Status(enum.Enum):
    """How a solve ended: a sentence that says what to try next."""

    SOLVED = "solved"
    UNREACHABLE = "a contact cannot be reached: move the contact or the obstacle"
    UNBALANCED = "the centre of mass cannot be kept inside the support polygon"
    COLLIDING = "collision: links come closer than the safety distance"
    SLIDING = (
        "the new contact is outside its contact-angle bound: it would slip when loaded"
    )
    OVERLOADED = (
        "no static equilibrium: no contact forces within friction cones and torque"
        " limits"
    )
    STUCK = "no contact change brings the robot nearer to its goal"
    EXHAUSTED = "every contact within the budget was tried"
    BUDGET = "the budget of tries or seconds was spent: allow more"


# What a file may be in place of what its name says: how it begins, what that is, and
# what to do then. The short names are for those who read such files.
_UNPACK, _SAVE = "unpack it first", "save positions, names and rate as .npz"
_KINDS: tuple[tuple[str, bytes, str, str], ...] = (
    ("", b"version https://git-lfs", "a Git LFS pointer", "`git lfs pull` fetches it"),
    ("", b"/annex/objects/", "a git-annex pointer", "`git annex get` fetches it"),
    ("", b"<!doctype html", "a web page", "fetch the file itself (Raw, on GitHub)"),
    ("", b"<html", "a web page", "fetch the file itself (Raw, on GitHub)"),
    ("", b"404: not found", "what a server says of a missing file", "fetch it again"),
    ("", b'{"message":', "what a server says of a missing file", "fetch it again"),
    ("npz", b"PK\x03\x04", "a zip archive", _UNPACK),
    ("", b"PK\x05\x06", "an empty zip archive", _UNPACK),
    ("", b"\x1f\x8b", "a gzip archive", _UNPACK),
    ("", b"BZh", "a bzip2 archive", _UNPACK),
    ("", b"\xfd7zXZ", "an xz archive", _UNPACK),
    ("", b"7z\xbc\xaf", "a 7-Zip archive", _UNPACK),
    ("", b"Rar!", "a RAR archive", _UNPACK),
    ("", b"(\xb5/\xfd", "a zstd archive", _UNPACK),
    ("", b"\x89HDF", "an HDF5 or MATLAB file", _SAVE),
    ("", b"MATLAB ", "a MATLAB file", _SAVE),
    ("", b"NO_OF_FRAMES", "a table of Qualisys", "export it as C3D"),
    ("", b"Trajectories", "a table of Vicon Nexus", "export it as C3D"),
    ("", b"Coordinates", "joint angles of OpenSim", "give the markers' TRC"),
    ("", b"#!OML:ASF", "an AMC", "convert it with its ASF to BVH"),
    ("", b"# AST/ASF", "an ASF", "convert it with its AMC to BVH"),
    ("", b"\xd0\xcf\x11\xe0", "a file of its program alone", "export it as C3D"),
    ("", b"PXR-USD", "a USD file", "export it as BVH or C3D"),
    ("", b"#usda", "a USD file", "export it as BVH or C3D"),
    ("", b"Kaydara FBX", "an FBX file", "export it as BVH or C3D"),
    ("", b"; FBX", "an FBX file", "export it as BVH or C3D"),
    ("gltf", b"glTF", "a glTF file", "export it as BVH, or as OBJ"),
    ("", b"BLENDER", "a Blender file", "export what it holds"),
    ("", b"%PDF", "a PDF", ""),
    ("", b"\x89PNG", "a picture", ""),
    ("", b"\xff\xd8\xff", "a picture", ""),
    ("", b"SQLite format", "a database", ""),
    ("", b"PAR1", "a Parquet file", _SAVE),
    ("pickle", b"\x80\x02", "a pickle", ""),
    ("pickle", b"\x80\x03", "a pickle", ""),
    ("pickle", b"\x80\x04", "a pickle", ""),
    ("pickle", b"\x80\x05", "a pickle", ""),
    ("npy", b"\x93NUMPY", "a NumPy array", ""),
    ("bvh", b"HIERARCHY", "a BVH recording", ""),
    ("trc", b"PathFileType", "a TRC recording", ""),
    ("csv", b"Format Version", "a recording of Motive", ""),
    ("xml", b"<?xml", "XML", ""),
    ("xml", b"<robot", "a URDF", ""),
    ("xml", b"<mujoco", "an MJCF", ""),
    ("xml", b"<sdf", "an SDF", ""),
    ("ply", b"ply\n", "a PLY mesh", "save it as OBJ or STL"),
)
_START = 512  # [byte] by which a file is told


def in_its_place(start: bytes, *own: str) -> str | None:
    """What a file is by its first bytes, and what to do; not of `own` kinds."""
    plain = start.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    for short, begins, what, then in _KINDS:
        if short not in own and plain.startswith(begins.lower()):
            return f"{what}: {then}" if then else what
    return f"a tar archive: {_UNPACK}" if start[257:262] == b"ustar" else None


def check_kind(path: Path, expected: str, *own: str) -> bytes:
    """Refuse a file that is of another kind by its first bytes.

    Args:
        path: The file.
        expected: What is wanted, for the message: `a scene`.
        own: Short names of kinds that will do: npz, pickle, npy, bvh, trc, csv,
            xml, ply, gltf.

    Returns:
        Its first bytes.

    Raises:
        InputError: It cannot be opened, is empty or of another kind.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_START)
    except OSError as e:
        raise unreadable(path, e) from e
    if not start:
        raise InputError(f"{expected}; this file is empty", path)
    if other := in_its_place(start, *own):
        raise InputError(f"{expected}; this is {other}", path)
    return start


def read_yaml(path: Path) -> dict:
    """A YAML mapping from disk.

    Raises:
        InputError: The file is missing, unreadable or no mapping.
    """
    import yaml  # slow to import, as pydantic below: who catches errors needs neither

    check_kind(path, "YAML")
    try:
        text = path.read_text()
        content = yaml.safe_load(text)
    except OSError as e:
        raise unreadable(path, e) from e
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        fault = str(e).splitlines()[0]
        if isinstance(e, yaml.MarkedYAMLError) and e.problem_mark is not None:
            fault = f"line {e.problem_mark.line + 1}: {e.problem}"
        raise InputError(f"YAML ({fault})", path) from e
    if not isinstance(content, dict):
        raise InputError("a mapping of fields", path, value=type(content).__name__)
    return content


def validated(kind: type[T], content: object, source: object) -> T:
    """Content read from `source`, validated by pydantic.

    Args:
        kind: A pydantic model, a dataclass, or any type that pydantic knows.
        content: Mappings, lists and plain values, as YAML or JSON have them.
        source: Named in errors: the file.

    Raises:
        InputError: A field is missing, unknown, or has a value that cannot be used.
    """
    import pydantic

    try:
        return pydantic.TypeAdapter(kind).validate_python(content)
    except pydantic.ValidationError as e:
        raise input_error(e, source) from e


def input_error(error: ValueError, source: object) -> InputError:
    """The first fault of a pydantic validation, with file, field and value."""
    import pydantic

    assert isinstance(error, pydantic.ValidationError)
    first = error.errors()[0]
    # Where a field may be one of two shapes, pydantic adds the shape to the path.
    shapes = ("tuple[", "union[", "list[")
    where = ".".join(x for x in map(str, first["loc"]) if not x.startswith(shapes))
    text = first["msg"].removeprefix("Value error, ").removeprefix("expected ")
    text = text.removeprefix("Input should be ")
    value = first.get("input")
    if first["type"] == "missing":
        text, value = "a value: it is missing", None
    elif first["type"] == "extra_forbidden":
        text = "no such field: correct its name, or leave it out"
    if not where:  # the fields together are wrong: their values are no help
        return InputError(text, source)
    return InputError(text, source, where, value)

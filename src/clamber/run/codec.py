"""Records <-> JSON and npz, by the type hints of their fields.

A record is an object of its fields, an array nested lists, an enum its name (of words,
its value), one of several records an object that says its `type`. What is None, False
or empty text by default is left out while it is so. A `Form` says where a file differs.
Reading checks everything and names file, field, value and what was expected.

A file is written beside its place and renamed, so that an interrupted run leaves whole
files only. The same records give the same bytes: JSON keeps the order in which it is
written and floats in their shortest exact form, and numpy dates what lies in an `.npz`
1980.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import json
import math
import os
import types
import typing
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from clamber.errors import InputError, unreadable
from clamber.planning.trajectory import Samples

VERSION = 2
_BROKEN = (
    OSError,
    ValueError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,
    TypeError,  # a single array, which is no context
)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """How a record stands in a file, where that is not field by field.

    Attributes:
        names: Keys of fields that are called otherwise there.
        beside: Fields that are records whose keys stand beside the record's own.
        null: What a number of a field is that JSON has no number for, by field.
        columns: Of arrays that may have no rows, by field.
        more: Keys that are for other readers alone.
        kinds: Of a record, those that it may be one of.
        write: The whole object in place of field by field, and
        read: the record of it; `ValueError` where it does not fit.
    """

    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    beside: Collection[str] = ()
    null: Mapping[str, float] = dataclasses.field(default_factory=dict)
    columns: Mapping[str, int] = dataclasses.field(default_factory=dict)
    more: Callable[[Any], Mapping[str, Any]] | None = None
    kinds: tuple[type, ...] = ()
    write: Callable[[Any], Mapping[str, Any]] | None = None
    read: Callable[[At], Any] | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class At:
    """A value of a file, and where it stands there."""

    value: Any
    file: Path
    field: str = ""

    def inside(self, key: object, value: Any) -> At:
        """A value within this one."""
        return At(value, self.file, f"{self.field}.{key}".lstrip("."))

    def error(self, expected: str, value: object = None) -> InputError:
        """That something about it is not what was expected."""
        field = self.field or None
        return InputError(expected, source=self.file, field=field, value=value)

    def wrong(self, expected: str) -> InputError:
        """That this value is not what was expected."""
        return self.error(expected, "null" if self.value is None else self.value)

    def object(self) -> dict[str, Any]:
        """It, an object of fields."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object of fields")
        return self.value

    def list(self) -> list[At]:
        """What is in it, a list."""
        if not isinstance(self.value, list):
            raise self.wrong("a list")
        return [self.inside(i, x) for i, x in enumerate(self.value)]

    def key(self, name: str) -> At:
        """A field of it, an object."""
        content = self.object()
        if name not in content:
            raise self.inside(name, None).error("a value: it is missing")
        return self.inside(name, content[name])


class Codec:
    """Records to what JSON and npz can say, and back."""

    def __init__(self, forms: Mapping[type, Form]) -> None:
        """Of records that differ in files from their fields."""
        self._forms = forms

    def _form(self, kind: type) -> Form:
        """That of a record, or of what it is one of."""
        forms = (self._forms[k] for k in kind.__mro__ if k in self._forms)
        return next(forms, Form())

    def _kinds(self, kind: Any) -> tuple[Any, ...]:
        """What a hint allows, and of records those that there are of one."""
        form = self._forms.get(kind, Form()) if isinstance(kind, type) else Form()
        return form.kinds or _arms(kind)

    # JSON.

    def encode(self, x: Any, kind: Any = None) -> Any:
        """Numbers, strings, lists and dictionaries; `kind` is the hint of its field."""
        match x:
            case enum.Enum():
                return _word(x)
            case np.ndarray() | np.generic():
                return self.encode(x.tolist())
            case float():
                return x if math.isfinite(x) else None
            case None | bool() | int() | str():
                return x
            case Mapping():
                of = ([*typing.get_args(kind), None, None])[1]
                return {
                    _word(k) if isinstance(k, enum.Enum) else str(k): self.encode(v, of)
                    for k, v in x.items()
                }
            case tuple() | list():
                return [
                    self.encode(v, of)
                    for v, of in zip(x, _items(kind, len(x)), strict=True)
                ]
        if not dataclasses.is_dataclass(x):
            raise TypeError(f"{type(x).__name__} does not go to a file")
        out = self.object(x)
        several = len([k for k in self._kinds(kind) if dataclasses.is_dataclass(k)]) > 1
        return {"type": type(x).__name__, **out} if several else out

    def object(self, x: Any, without: Collection[str] = ()) -> dict[str, Any]:
        """A record, all but some of its fields."""
        form = self._form(type(x))
        if form.write is not None:
            return self.encode(form.write(x))
        out = self.encode(form.more(x)) if form.more is not None else {}
        hints = _hints(type(x))
        for f in dataclasses.fields(x):
            value = getattr(x, f.name)
            if f.name in without:
                continue
            if f.name in form.beside:
                out |= self.object(value)
            elif f.init and not (_is_absent(value) and value == f.default):
                out[form.names.get(f.name, f.name)] = self.encode(value, hints[f.name])
        return out

    def decode(self, kind: Any, at: At) -> Any:
        """The value of that kind which `encode` made this of.

        Raises:
            InputError: It is none.
        """
        arms = self._kinds(kind)
        if len(arms) > 1:
            return self._one_of(arms, at)
        x, origin = at.value, typing.get_origin(kind) or kind
        if dataclasses.is_dataclass(kind):
            form = self._form(kind)
            try:
                if form.read is not None:
                    return form.read(at)
                return kind(**self.fields(kind, at))
            except (ValueError, KeyError) as e:
                reason = e.args[0] if e.args else e
                raise at.error(f"fields that fit together ({reason})") from e
        if kind is np.ndarray:
            return _array(at, math.nan, None)
        if isinstance(origin, type) and issubclass(origin, Mapping):
            key, of = typing.get_args(kind)
            return {
                self.decode(key, at.inside(k, k)): self.decode(of, at.inside(k, v))
                for k, v in at.object().items()
            }
        if origin in (tuple, list):
            inside = at.list()
            kinds = _items(kind, len(inside))
            if len(kinds) != len(inside):
                raise at.wrong(f"{len(kinds)} values")
            return origin(map(self.decode, kinds, inside))
        if isinstance(kind, type) and issubclass(kind, enum.Enum):
            words = {_word(member): member for member in kind}
            if not _is_text(x) or x not in words:
                raise at.wrong(f"one of {', '.join(words)}")
            return words[x]
        if origin is Literal:
            if x not in typing.get_args(kind):
                raise at.wrong(_named(kind))
            return x
        if kind is Any:
            return x
        good = isinstance(x, (int, float) if kind is float else kind)
        if not good or (isinstance(x, bool) and kind is not bool):
            raise at.wrong(_named(kind))
        return kind(x) if kind is float else x

    def fields(
        self, kind: type, at: At, without: Collection[str] = ()
    ) -> dict[str, Any]:
        """The fields of a record, all but those that are not in the file."""
        content, form, hints = at.object(), self._form(kind), _hints(kind)
        out: dict[str, Any] = {}
        for f in dataclasses.fields(kind):
            key = form.names.get(f.name, f.name)
            if f.name in without or not f.init:
                continue
            if f.name in form.beside:
                out[f.name] = self.decode(hints[f.name], at)
            elif key not in content:
                default = f.default, f.default_factory
                if default == (dataclasses.MISSING, dataclasses.MISSING):
                    at.key(key)
            else:
                inside = at.key(key)
                null, columns = form.null.get(f.name), form.columns.get(f.name)
                if hints[f.name] is np.ndarray:
                    out[f.name] = _array(inside, null, columns)
                elif null is not None and inside.value is None:
                    out[f.name] = null
                else:
                    out[f.name] = self.decode(hints[f.name], inside)
        return out

    def _one_of(self, arms: tuple[Any, ...], at: At) -> Any:
        """What one of several kinds makes of it; the fault of the last one, if none."""
        if at.value is None and type(None) in arms:
            return None
        arms = tuple(k for k in arms if k is not type(None))
        records = {k.__name__: k for k in arms if dataclasses.is_dataclass(k)}
        if len(records) > 1 and isinstance(at.value, dict):
            name = at.value.get("type")
            if name not in records:
                raise at.inside("type", name).wrong(f"one of {', '.join(records)}")
            return self.decode(records[name], at)
        for k in arms[:-1]:
            with contextlib.suppress(InputError):
                return self.decode(k, at)
        try:
            return self.decode(arms[-1], at)
        except InputError as e:
            if len(arms) == 1:
                raise
            said = " or ".join(_named(k) for k in arms)
            raise at.wrong(said) from e

    # npz.

    def arrays(self, x: Any, without: Collection[str] = ()) -> dict[str, Any]:
        """A record's arrays by key; numbers by name become two of them.

        The second one is called `<key>_keys`. What is neither numbers nor names is
        there as the text of its JSON; what is None is not.
        """
        names, hints = self._form(type(x)).names, _hints(type(x))
        out: dict[str, Any] = {}
        for f in dataclasses.fields(x):
            key, value = names.get(f.name, f.name), getattr(x, f.name)
            if f.name in without or value is None:
                continue
            if isinstance(value, Mapping):
                out[f"{key}_keys"] = np.array([*value], dtype=str)
                out[key] = np.array([*value.values()], dtype=float)
            elif isinstance(value, tuple) and not _is_names(hints[f.name]):
                out[key] = np.array(json.dumps(self.encode(value, hints[f.name])))
            else:
                out[key] = value
        return out

    def from_arrays(
        self,
        kind: type,
        arrays: Arrays,
        *,
        shapes: Mapping[str, tuple[str | int, ...]],
        without: Collection[str] = (),
    ) -> dict[str, Any]:
        """The fields of a record that `arrays` took apart.

        Args:
            kind: The record.
            arrays: Of the file.
            shapes: Sizes by key: numbers, or names of which the first array that has
                one says how much it is.
            without: Fields that are not in the file.
        """
        names = self._form(kind).names
        out: dict[str, Any] = {}
        known: dict[str, int] = {}
        for f in dataclasses.fields(kind):
            key, hint = names.get(f.name, f.name), _hints(kind)[f.name]
            optional = type(None) in _arms(hint)
            if f.name in without or (optional and key not in arrays):
                continue
            x = arrays.get(key, shapes.get(key, ()), known)
            origin = typing.get_origin(hint) or hint
            if np.ndarray in _arms(hint):
                out[f.name] = x
            elif isinstance(origin, type) and issubclass(origin, Mapping):
                keys = arrays.get(f"{key}_keys", (len(x),), known)
                out[f.name] = dict(zip(keys.tolist(), x.tolist(), strict=True))
            elif _is_names(hint):
                out[f.name] = tuple(x.tolist())
            elif origin is tuple:
                at = At(parse(x.item(), arrays.file, key), arrays.file, key)
                out[f.name] = self.decode(hint, at)
            else:
                out[f.name] = hint(x.item())
        return out


# Type hints.


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _arms(kind: Any) -> tuple[Any, ...]:
    """The kinds that a hint allows."""
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if union else (kind,)


def _items(kind: Any, n: int) -> list[Any]:
    """Hints of what is in a list or tuple of n, as far as its own hint says."""
    for k in _arms(kind):
        if typing.get_origin(k) in (tuple, list):
            args = typing.get_args(k)
            return [args[0]] * n if args[1:] in ((), (...,)) else [*args]
    return [None] * n


def _is_names(hint: Any) -> bool:
    return typing.get_origin(hint) is tuple and typing.get_args(hint)[0] is str


def _named(kind: Any) -> str:
    """A kind, for people."""
    if typing.get_origin(kind) is Literal:
        words = [repr(x) for x in typing.get_args(kind)]
        return " or ".join([", ".join(words[:-1]), words[-1]][len(words) == 1 :])
    words = {
        float: "a number",
        int: "a whole number",
        str: "text",
        bool: "true or false",
    }
    return words.get(kind, f"a {getattr(kind, '__name__', kind)}")


def _word(member: enum.Enum) -> str:
    """An enum's name; the value of one of words."""
    return member.value if isinstance(member, str) else member.name


def _is_text(x: object) -> bool:
    return isinstance(x, str)


def _is_absent(x: object) -> bool:
    return x is None or x is False or (isinstance(x, str) and not x)


def _array(at: At, null: float | None, columns: int | None) -> np.ndarray:
    """Nested lists as an array of floats, or of booleans; null stands for `null`."""
    try:
        x = np.array(at.value)
    except ValueError as e:
        raise at.error("rows of one length") from e
    if x.dtype.kind not in "bif" or not x.shape:
        x = np.array([_numbers(row, null) for row in at.list()])
    if x.dtype.kind == "i":
        x = x.astype(float)
    return x.reshape(0, columns) if columns is not None and not x.size else x


def _numbers(at: At, null: float | None) -> Any:
    if isinstance(at.value, list):
        return [_numbers(x, null) for x in at.list()]
    if at.value is None and null is not None:
        return null
    if isinstance(at.value, (int, float)):
        return at.value
    raise at.wrong("a number")


# Files.


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name beside `path`, same ending, that becomes `path` if the block completes."""
    draft = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield draft
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, `version` first, each list of numbers on one line."""
    with whole_file(path) as draft:
        draft.write_bytes(_text({"version": VERSION, **content}).encode() + b"\n")


def _text(x: Any, before: str = "\n") -> str:
    nested = (str, bool, list, dict)
    if not x or not (
        isinstance(x, dict)
        or (isinstance(x, list) and any(isinstance(v, nested) for v in x))
    ):
        return json.dumps(x, allow_nan=False)
    inside = before + " "
    if isinstance(x, dict):
        rows = [f"{json.dumps(k)}: {_text(v, inside)}" for k, v in x.items()]
        return "{" + inside + f",{inside}".join(rows) + before + "}"
    return "[" + inside + f",{inside}".join(_text(v, inside) for v in x) + before + "]"


def parse(text: str, file: Path, field: str = "", *, maker: str = "") -> Any:
    """What a text of JSON says, whose numbers are finite.

    Raises:
        InputError: It is not JSON.
    """

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no finite number")

    try:
        return json.loads(text, parse_constant=refuse)
    except ValueError as e:
        raise At(None, file, field).error(f"whole JSON ({e}); {maker}") from e


def read_json(path: Path, *, maker: str, versions: Collection[int] = (VERSION,)) -> At:
    """The object in a JSON file.

    Args:
        path: The file.
        maker: What to do where it is missing, broken or old.
        versions: Of its format that can be read.

    Raises:
        InputError: It is missing, no JSON object, or of another version.
    """
    try:
        text = path.read_text()
    except OSError as e:
        raise unreadable(path, e, maker) from e
    except ValueError as e:
        raise InputError(f"a JSON file ({e}); {maker}", path) from e
    at = At(parse(text, path, maker=maker), path)
    version = at.object().get("version", "absent")
    if version not in versions:
        old = ": clamber 0.1 made this file" if version == 1 else ""
        expected = f"version {VERSION} of the format{old}; {maker} anew"
        raise at.inside("version", version).wrong(expected)
    return at


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """As `np.savez_compressed` does; what is sampled, block after block."""
    with (
        whole_file(path) as draft,
        zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, x in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                if not isinstance(x, Samples):
                    np.lib.format.write_array(file, np.asarray(x), allow_pickle=False)
                    continue
                about = {"descr": "<f8", "fortran_order": False, "shape": x.shape}
                np.lib.format.write_array_header_1_0(file, about)
                for block in x.blocks():
                    file.write(block.astype("<f8").tobytes())


class Arrays:
    """The arrays of an `.npz`; what is missing or of another shape is the user's."""

    def __init__(self, file: Path, *, maker: str) -> None:
        """Read all of them; `maker` says what to do where they cannot be read."""
        self.file = file
        try:
            with file.open("rb") as stream, np.load(stream, allow_pickle=False) as f:
                self._arrays = {k: f[k] for k in f.files}
        except _BROKEN as e:
            reason = e.strerror if isinstance(e, OSError) and e.strerror else e
            if "pickle" in str(e):  # what numpy takes any other content for
                reason = "it holds something else"
            raise InputError(
                f"a whole .npz file ({reason}); {maker}", source=file
            ) from e

    def __contains__(self, name: str) -> bool:
        """Whether there is one of that name."""
        return name in self._arrays

    def get(
        self, name: str, shape: tuple[str | int, ...], sizes: dict[str, int]
    ) -> np.ndarray:
        """An array of finite numbers, or of names.

        Args:
            name: Its key.
            shape: Numbers, or names of sizes.
            sizes: Of names; those that are not known yet are those of this array.

        Raises:
            InputError: There is none of that shape.
        """
        if name not in self._arrays:
            raise InputError("an array: there is none", source=self.file, field=name)
        x = self._arrays[name]
        if len(shape) == x.ndim:
            for size, n in zip(shape, x.shape, strict=True):
                if isinstance(size, str):
                    sizes.setdefault(size, n)
        wanted = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in shape)
        if x.shape != wanted:
            text = ", ".join(map(str, wanted))
            field = f"shape of {name}"
            raise InputError(f"({text})", source=self.file, field=field, value=x.shape)
        if x.dtype.kind == "f" and not np.all(np.isfinite(x)):
            raise InputError("finite numbers only", source=self.file, field=name)
        return x

    def same(self, name: str, wanted: tuple[str, ...]) -> None:
        """Refuse names that are not those of the world."""
        if (found := tuple(self._arrays[name].tolist())) != wanted:
            expected = f"those of the scene, {', '.join(wanted)}"
            value = ", ".join(map(str, found))
            raise InputError(expected, source=self.file, field=name, value=value)

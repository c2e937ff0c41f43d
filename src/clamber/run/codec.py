"""Records <-> JSON and npz, by the type hints of their fields.

A record is an object of its fields, an array nested lists, an enum its name (of words,
its value), a record that is one of several kinds says its `type`. What is None, False
or empty text by default is left out while it is so. A `Form` says where a file differs.
Reading checks everything and names file, field, value and what was expected.

A file is written beside its place and renamed, so that an interrupted run leaves whole
files only. The same records give the same bytes: JSON keeps the order in which it is
written and floats in their shortest exact form, and numpy dates what lies in an `.npz`
1980.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import json
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from clamber.errors import InputError, check_kind, unreadable

VERSION = 2
_PLAIN = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
_BROKEN = (
    *(OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error),
    *(NotImplementedError, TypeError),  # of a single array, which is no context
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """File form of a record that is not written field by field.

    Attributes:
        names: Keys of fields that are called otherwise there.
        beside: Fields that are records whose keys stand beside the record's own.
        null: What a number of a field is that JSON has no number for, by field.
        columns: Of arrays that may have no rows, by field.
        more: Keys that are for other readers alone.
        kinds: Of a record that others are kinds of: those.
        write: The whole object in place of field by field, and
        read: the record of it; `ValueError` where it does not fit.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    beside: Collection[str] = ()
    null: Mapping[str, float] = field(default_factory=dict)
    columns: Mapping[str, int] = field(default_factory=dict)
    more: Callable[[Any], Mapping[str, Any]] | None = None
    kinds: tuple[type, ...] = ()
    write: Callable[[Any], Mapping[str, Any]] | None = None
    read: Callable[[At], Any] | None = None


@dataclass(frozen=True, slots=True)
class At:
    """A value of a file, and where it stands there."""

    value: Any
    file: Path
    field: str = ""

    def inside(self, key: object, value: Any) -> At:
        """A value within this one."""
        return At(value, self.file, f"{self.field}.{key}".lstrip("."))

    def error(self, expected: str, value: object = None) -> InputError:
        """Error: something about this value is not as expected."""
        return InputError(expected, self.file, self.field or None, value)

    def wrong(self, expected: str) -> InputError:
        """Error: this value is not as expected."""
        return self.error(expected, "null" if self.value is None else self.value)

    def object(self) -> dict[str, Any]:
        """It, an object of fields."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object of fields")
        return self.value

    def list(self) -> list[At]:
        """Items of this value, which must be a list."""
        if not isinstance(self.value, list):
            raise self.wrong("a list")
        return [self.inside(i, x) for i, x in enumerate(self.value)]

    def key(self, name: str) -> At:
        """A field of it, an object."""
        if name not in self.object():
            raise self.inside(name, None).error("a value: it is missing")
        return self.inside(name, self.value[name])

    def choice(self, of: Mapping[str, Any]) -> Any:
        """Entry of a mapping with this name."""
        if not isinstance(self.value, str) or self.value not in of:
            raise self.wrong(f"one of {', '.join(of)}")
        return of[self.value]


class Codec:
    """Records to what JSON and npz can say, and back."""

    def __init__(self, forms: Mapping[type, Form]) -> None:
        """`forms`: of records that are not written field by field."""
        self._forms = forms

    def _form(self, kind: type) -> Form:
        """Form of a record type, or of a base class."""
        forms = (self._forms[k] for k in kind.__mro__ if k in self._forms)
        return next(forms, Form())

    # JSON.

    def encode(self, x: Any) -> Any:
        """Numbers, strings, lists and dictionaries."""
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
                return {str(self.encode(k)): self.encode(v) for k, v in x.items()}
            case tuple() | list():
                return [self.encode(v) for v in x]
        return self.object(x)

    def object(self, x: Any, without: Collection[str] = ()) -> dict[str, Any]:
        """A record, all but some of its fields."""
        form = self._form(type(x))
        if form.write is not None:
            return self.encode(form.write(x))
        out = {"type": type(x).__name__} if form.kinds else {}
        out |= {} if form.more is None else self.encode(form.more(x))
        for f in (f for f in fields(x) if f.init):
            value = getattr(x, f.name)
            plain = value is None or isinstance(value, (bool, str))
            if f.name in without or (plain and not value and value == f.default):
                continue
            if f.name in form.beside:
                out |= self.object(value)
            else:
                out[form.names.get(f.name, f.name)] = self.encode(value)
        return out

    def decode(self, kind: Any, at: At) -> Any:
        """The value of that kind which `encode` made this of.

        Raises:
            InputError: It is none.
        """
        arms = _arms(kind)
        if at.value is None and type(None) in arms:
            return None
        kind, *others = (k for k in arms if k is not type(None))
        if others:
            return self._first((kind, *others), at)
        x, origin, args = at.value, get_origin(kind) or kind, get_args(kind)
        if is_dataclass(kind):
            return self._record(kind, at)
        if kind is np.ndarray:
            return _array(at)
        if origin is Literal:
            return at.choice({word: word for word in args})
        if issubclass(origin, enum.Enum):
            return at.choice({_word(member): member for member in origin})
        if issubclass(origin, Mapping):
            return {
                self.decode(args[0], at.inside(k, k)): self.decode(args[1], inside)
                for k in at.object()
                for inside in (at.key(k),)
            }
        if issubclass(origin, tuple):
            inside = at.list()
            kinds = [args[0]] * len(inside) if args[1:] == (...,) else args
            if len(kinds) != len(inside):
                raise at.wrong(f"{len(kinds)} values")
            return tuple(map(self.decode, kinds, inside))
        if type(x) is int and kind is float:
            return float(x)
        if type(x) is not kind:
            raise at.wrong(_PLAIN[kind])
        return x

    def _first(self, kinds: tuple[Any, ...], at: At) -> Any:
        """Value as read by the first of several types that accepts it."""
        expected = []
        for kind in kinds:
            try:
                return self.decode(kind, at)
            except InputError as e:
                expected.append(e.expected)
        raise at.wrong(" or ".join(expected))

    def _record(self, kind: Any, at: At) -> Any:
        form = self._form(kind)
        if form.kinds and kind not in form.kinds:
            return self._record(at.key("type").choice(_by_name(form.kinds)), at)
        try:
            return form.read(at) if form.read else kind(**self.fields(kind, at))
        except (ValueError, KeyError) as e:
            reason = e.args[0] if e.args else e
            raise at.error(f"fields that fit together ({reason})") from e

    def fields(
        self, kind: type, at: At, without: Collection[str] = ()
    ) -> dict[str, Any]:
        """The fields of a record, all but those that are not in the file."""
        content, form, hints = at.object(), self._form(kind), _hints(kind)
        out: dict[str, Any] = {}
        for f in fields(kind):
            key = form.names.get(f.name, f.name)
            missing = (f.default, f.default_factory) == (MISSING, MISSING)
            if f.name in without or not f.init:
                continue
            if f.name in form.beside:
                out[f.name] = self.decode(hints[f.name], at)
            elif key in content or missing:
                inside, null = at.key(key), form.null.get(f.name)
                if hints[f.name] is np.ndarray:
                    out[f.name] = _array(inside, null, form.columns.get(f.name))
                elif null is not None and inside.value is None:
                    out[f.name] = null
                else:
                    out[f.name] = self.decode(hints[f.name], inside)
        return out

    # npz.

    def arrays(self, x: Any, without: Collection[str] = ()) -> dict[str, Any]:
        """A record's arrays by key.

        What is neither numbers nor names is there as the text of its JSON; what is None
        is not.
        """
        names, hints = self._form(type(x)).names, _hints(type(x))
        out: dict[str, Any] = {}
        for f in fields(x):
            value = getattr(x, f.name)
            if f.name in without or value is None:
                continue
            if isinstance(value, tuple) and hints[f.name] != tuple[str, ...]:
                value = json.dumps(self.encode(value))
            out[names.get(f.name, f.name)] = value
        return out

    def from_arrays(
        self,
        kind: type,
        arrays: Mapping[str, np.ndarray],
        file: Path,
        shapes: Mapping[str, tuple[str | int, ...]],
        without: Collection[str] = (),
    ) -> dict[str, Any]:
        """The fields of a record that `arrays` took apart.

        Args:
            kind: The record.
            arrays: Of the file, by key.
            file: That they are from.
            shapes: Sizes by key: numbers, or names of which the first array that has
                one says how much it is.
            without: Fields that are not in the file.
        """
        names = self._form(kind).names
        out: dict[str, Any] = {}
        sizes: dict[str, int] = {}
        for f in fields(kind):
            key, hint = names.get(f.name, f.name), _hints(kind)[f.name]
            at, x = At(None, file, key), arrays.get(key)
            if f.name in without or (x is None and f.default is None):
                continue
            if x is None:
                raise at.error("an array: there is none")
            _check_shape(x, shapes.get(key, ()), sizes, at)
            if x.dtype.kind == "f" and not np.all(np.isfinite(x)):
                raise at.error("finite numbers only")
            if np.ndarray in _arms(hint):
                out[f.name] = x
            elif hint == tuple[str, ...]:
                out[f.name] = tuple(x.tolist())
            elif get_origin(hint) is tuple:
                out[f.name] = self.decode(hint, At(parse(x.item(), at), file, key))
            else:
                out[f.name] = hint(x.item())
        return out


def _check_shape(
    x: np.ndarray, shape: tuple[str | int, ...], sizes: dict[str, int], at: At
) -> None:
    """Refuse another shape; sizes that are not known yet are those of this array."""
    if len(shape) == x.ndim:
        for size, n in zip(shape, x.shape, strict=True):
            sizes.setdefault(str(size), n if isinstance(size, str) else size)
    wanted = tuple(sizes.get(str(size), size) for size in shape)
    if x.shape != wanted:
        raise at.error(f"the shape ({', '.join(map(str, wanted))})", x.shape)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _arms(kind: Any) -> tuple[Any, ...]:
    """The kinds that a hint allows."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _by_name(kinds: tuple[type, ...]) -> dict[str, type]:
    return {k.__name__: k for k in kinds}


def _word(member: enum.Enum) -> str:
    """An enum's name; the value of one of words."""
    return member.value if isinstance(member, str) else member.name


def _array(at: At, null: float | None = None, columns: int | None = None) -> np.ndarray:
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
    if not isinstance(at.value, (int, float)):
        raise at.wrong("a number")
    return at.value


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
    """JSON with a line for each item, but for those of a list of numbers."""
    inside = before + " "
    if isinstance(x, dict) and x:
        rows = [f"{json.dumps(k)}: {_text(v, inside)}" for k, v in x.items()]
        return "{" + inside + f",{inside}".join(rows) + before + "}"
    if isinstance(x, list) and any(isinstance(v, (str, bool, list, dict)) for v in x):
        rows = [_text(v, inside) for v in x]
        return "[" + inside + f",{inside}".join(rows) + before + "]"
    return json.dumps(x, allow_nan=False)


def parse(text: str, at: At, maker: str = "") -> Any:
    """Parses JSON; numbers must be finite.

    Raises:
        InputError: It is not JSON.
    """

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no finite number")

    try:
        return json.loads(text, parse_constant=refuse)
    except ValueError as e:
        raise at.error(f"whole JSON ({e}); {maker}") from e


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
        check_kind(path, "a JSON file")
        raise InputError(f"a JSON file ({e}); {maker}", path) from e
    if text:
        check_kind(path, "a JSON file")
    at = At(parse(text, At(None, path), maker), path)
    version = at.object().get("version", "absent")
    if version not in versions:
        old = ": clamber 0.1 made this file" if version == 1 else ""
        expected = f"version {VERSION} of the format{old}; {maker} anew"
        raise at.inside("version", version).wrong(expected)
    return at


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """As `np.savez_compressed` does, only quickly.

    Tables that single precision holds to the last bit are written so, column after
    column: what changes slowly is small then.
    """
    with (
        whole_file(path) as draft,
        zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, x in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, _single(x), allow_pickle=False)


def _single(x: Any) -> np.ndarray:
    """A table (n, ...) in single precision, where that loses nothing.

    What is sampled block after block is never all there in double precision.
    """
    if hasattr(x, "blocks"):
        out, k = np.empty(x.shape, "<f4", order="F"), 0
        for block in x.blocks():
            out[k : k + len(block)] = block
            if not np.array_equal(out[k : k + len(block)], block):
                break
            k += len(block)
        else:
            return out
    x = np.asarray(x)
    if x.dtype != np.float64 or x.ndim < 2:
        return x
    less = np.asfortranarray(x, dtype="<f4")
    return less if np.array_equal(less, x) else x


def _double(x: np.ndarray) -> np.ndarray:
    """Converts single to double precision, row by row."""
    return x.astype(float, order="C") if x.dtype == np.float32 else x


def read_npz(path: Path, *, maker: str) -> dict[str, np.ndarray]:
    """The arrays of an `.npz`.

    Raises:
        InputError: It cannot be read; `maker` says what to do then.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as f:
            return {k: _double(f[k]) for k in f.files}
    except _BROKEN as e:
        reason = e.strerror if isinstance(e, OSError) and e.strerror else e
        if "pickle" in str(e):  # what numpy takes any other content for
            reason = "it holds something else"
        raise InputError(f"a whole .npz file ({reason}); {maker}", path) from e

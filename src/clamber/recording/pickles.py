"""Pickles as plain data: arrays, numbers, text, lists, dictionaries; no code runs.

A pickle names functions to call. Here none of them is: the few that make arrays have
stand-ins of our own, objects of SciPy's sparse matrices, chumpy and the tools that
write motions become `Plain`, and whatever else is named is refused.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from clamber.errors import InputError, check_kind

MAX_BYTES = 1 << 30  # of a file
# Objects that are taken as what they hold; none of these modules is imported.
_HARMLESS = re.compile(
    r"(scipy\.sparse|chumpy|anim|parc|mimickit|(parc\.)?util\.terrain_util)(\.|$)"
)
_CODE = re.compile(r"[|<>=]?[biufc]\d{1,2}|[|<>=]?[SU]\d{1,6}|[|<>=]?\?")
_TOO_MUCH = (
    ValueError, EOFError, TypeError, AttributeError, LookupError, MemoryError,
    ArithmeticError, RecursionError, NotImplementedError, pickle.UnpicklingError,
    struct.error, UnicodeError, AssertionError, ImportError, StopIteration,
)  # fmt: skip


class Plain:
    """An object's state, without the object: `Plain.state` and `Plain.made_of`."""

    def __init__(self, *made_of: object, **named: object) -> None:
        """Keep what it would be made of."""
        self.made_of, self.state = made_of, dict(named)

    def __setstate__(self, state: object) -> None:
        """Keep the state."""
        if isinstance(state, tuple) and len(state) == 2:
            state = {**(state[0] or {}), **(state[1] or {})}
        self.state = state if isinstance(state, dict) else {"": state}


class _Dtype:
    """Stand-in for `numpy.dtype`: the arguments that it is called with."""

    def __init__(self, code: str = "", *_: object) -> None:
        self.code, self.order = str(code), ""

    def __setstate__(self, state: tuple) -> None:
        self.order = state[1] if state[1] in ("<", ">", "|") else ""

    def dtype(self) -> np.dtype:
        code = self.code.lstrip("<>|=")
        if not _CODE.fullmatch(code):
            raise ValueError(f"an array of {self.code!r}")
        return np.dtype(self.order + code if code[0] not in "SU?" else code)


class _Array:
    """An array on its way."""

    def __init__(self, *_: object) -> None:
        self.value: object = None

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, by_columns, raw = state
        self.value = _array(raw, dtype, shape, "F" if by_columns else "C")


class _Following(_Array):
    """An array of joblib's, whose bytes follow in the file."""

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def read(self, read: Callable[[int], bytes]) -> None:
        """Take the bytes, after as many as align them."""
        shape, dtype = self.state["shape"], self.state["dtype"]
        if self.state.get("numpy_array_alignment_bytes") is not None:
            read(read(1)[0])
        if not isinstance(dtype, _Dtype):
            raise ValueError("an array of an unknown kind")
        size = dtype.dtype().itemsize * math.prod(int(n) for n in shape)
        if not 0 <= size <= MAX_BYTES:
            raise ValueError(f"an array of {size} bytes")
        self.value = _array(read(size), dtype, shape, str(self.state["order"]))


def _array(raw: object, dtype: object, shape: object, order: str = "C") -> object:
    """An array of its bytes; of objects, their list."""
    if isinstance(dtype, _Dtype) and dtype.code.lstrip("<>|=")[:1] == "O":
        return list(raw) if isinstance(raw, list) else []
    raw = raw.encode("latin-1") if isinstance(raw, str) else raw
    if not isinstance(dtype, _Dtype) or not isinstance(raw, bytes | bytearray):
        raise ValueError("an array without bytes")
    sizes = [shape] if isinstance(shape, int) else list(shape)  # type: ignore[arg-type]
    flat = np.frombuffer(bytes(raw), dtype=dtype.dtype())
    return flat.reshape([int(n) for n in sizes], order="F" if order == "F" else "C")


def _scalar(dtype: object, raw: object = b"") -> object:
    value = _array(raw, dtype, 1)
    return value[0].item() if isinstance(value, np.ndarray) else value


def _remade(kind: object, *_: object) -> Plain:
    if kind is not Plain:
        raise pickle.UnpicklingError("an object of an unknown kind")
    return Plain()


def _encoded(text: str, _: str = "latin1") -> bytes:
    return text.encode("latin-1")


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): "numpy.ndarray",  # is named, and called by nobody
    ("copyreg", "_reconstructor"): _remade,
    ("copy_reg", "_reconstructor"): _remade,
    ("builtins", "object"): "object",
    ("__builtin__", "object"): "object",
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _Following,
    ("collections", "OrderedDict"): dict,
    ("_codecs", "encode"): _encoded,
    **{
        (f"numpy.{core}.{module}", name): made
        for core in ("core", "_core")
        for module, name, made in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _array),
        )
    },
}


def _build(reader: Any) -> None:
    """Give a state to what is ours alone."""
    made = reader.stack[-2]
    if not isinstance(made, Plain | _Array | _Dtype):
        raise pickle.UnpicklingError("a state for what has none")
    made.__setstate__(reader.stack.pop())
    if isinstance(made, _Following):
        made.read(reader.read)


class _Reader(pickle._Unpickler):  # pyright: ignore
    """In Python, where an index that is out of bounds costs no memory."""

    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,  # pyright: ignore
        pickle.BUILD[0]: _build,
    }

    def find_class(self, module: str, name: str) -> Any:
        """A stand-in of ours."""
        if (module, name) in _STAND_INS:
            return _STAND_INS[module, name]
        if _HARMLESS.match(module):
            return Plain
        raise pickle.UnpicklingError(f"it calls {module}.{name}, which is not allowed")

    def persistent_load(self, pid: object) -> Any:
        """Nothing lies elsewhere."""
        raise pickle.UnpicklingError("it refers to something outside")


def read_pickle(path: Path) -> object:
    """Contents of a pickle, as plain data.

    Raises:
        InputError: It cannot be read, is too large, or calls what is not allowed.
    """
    check_kind(path, "a pickle", "pickle")
    if path.stat().st_size > MAX_BYTES:
        expected = f"at most {MAX_BYTES} bytes"
        raise InputError(expected, path, value=path.stat().st_size)
    try:
        with path.open("rb") as file:
            made = _Reader(io.BytesIO(file.read()), encoding="latin-1").load()
        return _plain(made, {}, 0)
    except _TOO_MUCH as e:
        fault = " ".join(str(e).split())[:100] or type(e).__name__
        raise InputError(f"a pickle of plain arrays ({fault})", path) from e


def _plain(x: object, seen: dict[int, object], depth: int) -> object:
    """The same with arrays in place of what stands for them, each thing once."""
    if depth > 50:
        raise RecursionError("nested too deeply")
    if id(x) in seen:
        return seen[id(x)]
    if isinstance(x, _Array):
        return x.value
    if isinstance(x, dict):
        out: Any = {}
        seen[id(x)] = out
        out.update({k: _plain(v, seen, depth + 1) for k, v in x.items()})
        return out
    if isinstance(x, list | tuple):
        out = []
        seen[id(x)] = out
        out.extend(_plain(v, seen, depth + 1) for v in x)
        return out
    if isinstance(x, Plain):
        seen[id(x)] = x
        x.state = {k: _plain(v, seen, depth + 1) for k, v in x.state.items()}
    return x


def as_array(x: object) -> np.ndarray:
    """Numbers of an array, a list, a sparse matrix of SciPy's or an array of chumpy's.

    Raises:
        ValueError: It is none of these.
    """
    if isinstance(x, Plain):
        if {"data", "indices", "indptr"} <= x.state.keys():
            return _dense(x.state)
        inner = next((x.state[k] for k in ("x", "_x", "a") if k in x.state), None)
        if inner is None:
            raise ValueError(f"an object with {sorted(map(str, x.state))}")
        return as_array(inner)
    out = np.asarray(x)
    if out.dtype.kind not in "biuf":
        raise ValueError("no numbers")
    return out.astype(float)


def _dense(state: dict) -> np.ndarray:
    """Dense form of a compressed sparse matrix: CSC if that fits, else CSR."""
    rows, columns = (int(n) for n in state["_shape" if "_shape" in state else "shape"])
    if rows * columns > 10_000_000:
        raise ValueError("too large a matrix")
    data, indices, ends = (np.asarray(state[k]) for k in ("data", "indices", "indptr"))
    by_columns = len(ends) == columns + 1
    major = np.repeat(np.arange(len(ends) - 1), np.diff(ends.astype(int)))
    at = (indices.astype(int), major) if by_columns else (major, indices.astype(int))
    out = np.zeros((rows, columns))
    out[at] = data
    return out

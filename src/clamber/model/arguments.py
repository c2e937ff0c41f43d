"""Arguments of public functions: what is of another kind is named at once."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Sequence
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar

from clamber.errors import InputError, WrongType

F = TypeVar("F", bound=Callable[..., Any])
_PLAIN = {str: "str", Path: "Path", bool: "bool", Real: "number", NoneType: "None"}


def checks_types(function: F) -> F:
    """Have a function refuse arguments that are not what its annotations say.

    Records of the package, sequences of them, paths, numbers and choices are looked at,
    other annotations are not. What is wrong is a `WrongType`, or an `InputError` where
    there is no such choice.
    """

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        signature, kinds = _kinds_of(function)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in kinds and not any(_fits(k, value) for k in kinds[name]):
                raise _refusal(function.__name__, name, kinds[name], value)
        return function(*args, **kwargs)

    return checked  # pyright: ignore[reportReturnType]


@functools.cache
def _kinds_of(
    function: Callable[..., Any],
) -> tuple[inspect.Signature, dict[str, list[Any]]]:
    """Its signature, and what each argument may be, where that is looked at."""
    hints, found = typing.get_type_hints(function), {}
    signature = inspect.signature(function)
    for name in signature.parameters:
        kinds = _members(hints.get(name, Any))
        if all(map(_looked_at, kinds)):
            found[name] = kinds
    return signature, found


def _members(hint: Any) -> list[Any]:
    """The kinds of a union, or the only one."""
    if typing.get_origin(hint) in (typing.Union, UnionType):
        return [m for h in typing.get_args(hint) for m in _members(h)]
    return [Real if hint in (int, float) else hint]


def _looked_at(kind: Any) -> bool:
    origin = typing.get_origin(kind)
    if origin is Sequence:
        return _looked_at(typing.get_args(kind)[0])
    own = isinstance(kind, type) and kind.__module__.startswith("clamber.")
    own = own and not getattr(kind, "_is_protocol", False)
    return own or origin is Literal or kind in _PLAIN


def _fits(kind: Any, value: object) -> bool:
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return isinstance(value, str) and value in inside
    if origin is Sequence:
        if not isinstance(value, Sequence) or isinstance(value, str):
            return False
        return all(_fits(inside[0], x) for x in value)
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _refusal(function: str, name: str, kinds: list[Any], value: object) -> InputError:
    """The error for an argument that has none of the accepted types."""
    of = [k for k in kinds if typing.get_origin(k) is Literal]
    choices = [c for k in of for c in typing.get_args(k)]
    if choices and isinstance(value, str):
        expected = f"one of {', '.join(map(str, choices))}"
        return InputError(expected, f"{function}()", name, value)
    names = [_name(k) for k in kinds if k is not NoneType]
    return WrongType(function, name, names, value)


def _name(kind: Any) -> str:
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return "choice"
    if origin is Sequence:
        return f"sequence of {_name(inside[0])}"
    return _PLAIN[kind] if kind in _PLAIN else str(kind.__name__)

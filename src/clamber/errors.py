"""What can go wrong, as values and as exceptions.

A user's mistake is an `InputError` that names file, field, value and what was
expected. A problem without a solution is a `Status`, raised as `Infeasible` only on
request. A missing optional package is a `MissingDependency` with the line that gets it.
"""

from __future__ import annotations

import enum


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
        *,
        source: object = None,
        field: str | None = None,
        value: object = None,
    ) -> None:
        """Compose the sentence."""
        self.expected, self.source, self.field, self.value = (
            expected,
            source,
            field,
            value,
        )
        where = ": ".join(str(x) for x in (source, field) if x is not None)
        what = ":" if value is None else f" is {value!r};"
        sentence = f"{where}{what} expected {expected}" if where else expected
        super().__init__(sentence)


def unreadable(
    path: object, error: OSError, then: str = "check the path"
) -> InputError:
    """A file that cannot be opened, why, and what to do then."""
    why = error.strerror or "unreadable"
    return InputError(f"a readable file ({why}); {then}", source=path)


class Infeasible(ClamberError):
    """A problem has no solution; `result` holds the best that was found."""

    def __init__(self, message: str, result: object = None) -> None:
        """Keep the best that was found."""
        self.result = result
        super().__init__(message)


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
    NOT_CONVERGED = "iterations ran out before the contacts closed: allow more"
    UNREACHABLE = "a contact cannot be reached: move the contact or the obstacle"
    UNBALANCED = "the centre of mass cannot be held over the supporting contacts"
    COLLIDING = "links collide or come closer than the safety distance"
    SLIDING = "a new contact cannot support its mass within the friction cone"
    OVERLOADED = "no contact forces within the friction cones and torque limits hold it"

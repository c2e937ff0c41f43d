"""Records that notebooks and browsers display; `show` registers how.

The package says who shows them (`shown_by`) before any record is made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_shows: list[Callable[[], Any]] = []


def shown_by(load: Callable[[], Any]) -> None:
    """Have records be shown by a module, loaded when the first one is.

    Args:
        load: Returns the module: its `html(record)` is what a notebook shows, its
            `view(record, plan)` opens a page in the browser.
    """
    _shows[:] = [load]


class Shown:
    """A record that a notebook shows as a table with a picture."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return _shows[0]().html(self)


class Viewed(Shown):
    """A record that can also be played in the browser."""

    __slots__ = ()

    def show(self, plan: Any = None) -> Any:
        """Play it in the browser (takes `clamber[view]`).

        Args:
            plan: Of a rollout that was read from disk: the plan that it ran.

        Returns:
            The page, as `open_view` returns it; a notebook shows the page itself. It is
            served until `close()` or the end of the program.

        Raises:
            MissingDependency: There is no viser.
            InputError: It is a rollout that does not know its plan.
        """
        return _shows[0]().view(self, plan)

"""Time plots in the panel of a run's page, with values under the pointer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from clamber.show.page import Page
from clamber.show.sample import Motion, peaks, row_at

MOST = 500  # samples: as many as the panel is wide [px]
HEIGHT = 200  # [px]
MARGIN = 0.05  # above and below the series
FEW = 5  # joints that are named
COLOURS = ("#2563eb", "#c2410c", "#0891b2", "#d97706", "#7c3aed", "#db2777", "#15803d")
NOW = "#dc2626"
# The mark of the present has no value under the pointer: it is not in the legend.
MARK = "clamber-now"
STYLE = f"<style>.u-legend .{MARK} {{display: none}}</style>"
_Series = Mapping[str, np.ndarray]  # (n,) by name


def series_of(m: Motion) -> dict[str, _Series]:
    """Time series of a motion, by title of the plot: series (n,) by name."""
    found: dict[str, _Series] = {}
    margin = {"measured" if m.loads is not None else "planned": m.margin}
    if m.planned_margin is not None:
        margin["planned"] = m.planned_margin
    found["CoM margin [m]"] = margin
    names = m.world.surfaces
    if m.size is not None:
        found["contact forces [N]"] = dict(zip(names, m.size.T, strict=True))
    if m.effort is not None:
        most = np.argsort(-np.abs(m.effort).max(axis=0))[:FEW]
        joints = {list(m.world.joints)[i]: 100 * m.effort[:, i] for i in most}
        found["joint torque [% of its limit]"] = joints
    if m.error is not None:
        found["joint tracking error [rad]"] = {
            "largest": m.error[:, 0],
            "rms": m.error[:, 1],
        }
        found["base position error [m]"] = {"distance": m.error[:, 2]}
    heights = dict(zip(names, m.points[:, :, 2].T, strict=True))
    found["heights of surfaces [m]"] = heights
    return found


class Chart:
    """One plot, what it is of, and a mark at the present time."""

    def __init__(self, page: Page, motion: Callable[[], Motion]) -> None:
        """Add it to the panel.

        Args:
            page: With the panel.
            motion: What is on the page at present.
        """
        self._page, self._motion, self._plot = page, motion, None
        self._title = ""
        gui = page.server.gui
        with gui.add_folder("Over time", expand_by_default=False) as self._folder:
            self._choice: Any = gui.add_dropdown("plot", ("",))
            gui.add_html(STYLE)
        self._choice.on_update(lambda _: self._chosen())
        with page.clock.lock:
            self.renew()

    def renew(self) -> None:
        """There is another motion to plot; the clock's lock is held."""
        self._all, chosen = series_of(self._motion()), str(self._choice.value)
        self._choice.options = tuple(self._all)
        self._choice.value = chosen if chosen in self._all else next(iter(self._all))
        self._draw()

    def show(self, t: float) -> None:
        """Mark a time [s]."""
        if self._plot is not None:
            self._plot.data = (*self._data, self._mark(t))

    def _chosen(self) -> None:
        """Another plot was chosen by the user."""
        with self._page.clock.lock:
            if str(self._choice.value) != self._title:
                self._draw()

    def _draw(self) -> None:
        """The plot that is chosen, in place of the one before."""
        time = self._motion().time
        self._title = str(self._choice.value)
        series = self._all[self._title]
        rows = np.unique(np.linspace(0, len(time) - 1, min(MOST, len(time))).round())
        rows = rows.astype(int)
        lines = peaks(np.column_stack([*series.values()]), rows)
        self._data = (time[rows], *lines.T.copy())
        looks: list[Any] = [{"label": "t [s]"}]
        for i, name in enumerate(series):
            looks.append(
                {"label": name, "stroke": COLOURS[i % len(COLOURS)], "width": 1.5}
            )
        # The browser would find no range among the gaps of the mark.
        finite = lines[np.isfinite(lines)]
        least, most = float(finite.min(initial=0.0)), float(finite.max(initial=0.0))
        room = MARGIN * (most - least) or 1.0
        points = {"show": True, "size": 8}
        mark = {"label": "now", "stroke": NOW, "points": points, "class": MARK}
        looks.append(mark)
        if self._plot is not None:
            self._plot.remove()
        with self._folder:
            self._plot = self._page.server.gui.add_uplot(
                (*self._data, self._mark(self._page.clock.t)),
                tuple(looks),
                scales={
                    "x": {"time": False},
                    "y": {"range": (least - room, most + room)},
                },
                height=HEIGHT,
            )

    def _mark(self, t: float) -> np.ndarray:
        """(n,) the first series at a time [s] alone."""
        row, out = row_at(self._data[0], t), np.full(len(self._data[0]), np.nan)
        out[row] = self._data[1][row]
        return out

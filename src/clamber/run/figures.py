"""A figure as a file: what all plots share."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clamber.run.codec import whole_file


def finish_axes(ax: Axes) -> None:
    """Legend, two spines, small labels."""
    ax.legend(fontsize=8, frameon=False, loc="upper right")
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)


def save_plot(fig: Figure, path: str | Path) -> Path:
    """Write a figure whole, without the date or version of what drew it."""
    path = Path(path)
    with whole_file(path) as draft:
        fig.savefig(draft, dpi=110, metadata={"Software": None})
    return path

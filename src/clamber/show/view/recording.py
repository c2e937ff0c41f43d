"""A recording on the page, before anything is planned; and what is left of a run.

A run of which no motion can be read still has figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.recording.demonstration import Demonstration
from clamber.show.sample import stance_rows
from clamber.show.view import charts
from clamber.show.view.page import Page, views_of
from clamber.show.view.person import change_times, figure_at, show_person
from clamber.show.view.stage import Stick

SEEN = 60  # samples of which the camera takes all in
FOVY = 45.0  # [deg]


def recording_page(
    demo: Demonstration,
    sequence: ContactSequence | None,
    missing: Sequence[str],
    host: str,
    port: int,
) -> Page:
    """Serve a recording.

    Args:
        demo: It.
        sequence: What was detected in it; None where that could not be done.
        missing: A sentence for each thing that cannot be shown.
        host: To listen on.
        port: From which on a free one is taken.
    """
    page = Page(host, port, demo.source)
    page.missing = list(missing)
    gui = page.server.gui
    gui.add_html(charts.notes(missing, *demo.notes))
    person = show_person(demo, sequence, np.zeros(3))
    stick = Stick(page.server, person, "/person")
    rows = np.unique(np.linspace(0, len(demo.t) - 1, SEEN).round().astype(int))
    points = person.position[rows].reshape(-1, 3)
    page.look(views_of(points, float(demo.scene.start[2]), FOVY))
    tabs = gui.add_tab_group()
    with tabs.add_tab("Stances"):
        if sequence is not None:
            gui.add_html(charts.sequence_table(sequence, jumps=True))
    with tabs.add_tab("Plots"):
        gui.add_html(charts.recording_plots(person))
    with tabs.add_tab("Show"):
        page.add_cameras()

    def show(t: float) -> None:
        stick.show(figure_at(person, t))

    def show_figures(t: float) -> None:
        page.head.content = charts.recording_clock(person, t)

    page.watch(show)
    page.watch(show_figures, panel=True)
    page.span(float(demo.t[0]), float(demo.t[-1]), change_times(person))
    return page


def figures_page(
    title: str,
    written: Mapping[str, Any],
    verdict: Mapping[str, Any],
    sequence: ContactSequence | None,
    missing: Sequence[str],
    host: str,
    port: int,
) -> Page:
    """Serve what is left of a run of which no motion can be read."""
    page = Page(host, port, title)
    page.missing = list(missing)
    gui = page.server.gui
    gui.add_html(charts.notes(missing))
    times: list[float | None] = [None] * len(written.get("keyframes", []))
    tabs = gui.add_tab_group()
    with tabs.add_tab("Stances"):
        if written:
            gui.add_html(charts.stance_table(stance_rows(written, times)))
        elif sequence is not None:
            gui.add_html(charts.sequence_table(sequence, jumps=False))
        gui.add_html(charts.verdict_table(verdict))
    return page

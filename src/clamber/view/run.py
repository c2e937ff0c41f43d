"""A run on the page."""

from __future__ import annotations

from typing import Any

from clamber.model import Kinematics
from clamber.motion import Run, seen_points
from clamber.view import charts
from clamber.view.page import Page, views_of
from clamber.view.shown import Shown, frame_at
from clamber.view.stage import LAYERS, Stage


def run_page(run: Run, shown: Shown, host: str, port: int) -> Page:
    """Serve a run."""
    page = Page(host, port, run.folder.resolve().name)
    server = page.server
    world = shown.world
    kin = Kinematics(world)
    fovy = float(world.model.vis.global_.fovy)
    page.look(views_of(seen_points(kin, shown.q), float(world.scene.start[2]), fovy))
    stage = Stage(server, shown, "/run")
    gui = server.gui
    tabs = gui.add_tab_group()
    with tabs.add_tab("Stances"):
        gui.add_html(charts.legend())
        gui.add_html(charts.stance_table(shown))
        gui.add_html(charts.verdict_table(run.verdict))
    with tabs.add_tab("Plots"):
        gui.add_html(charts.plots(shown))
    with tabs.add_tab("Show"):
        page.add_cameras()
        for name, on in LAYERS.items():
            box = gui.add_checkbox(name, on)

            def changed(_: Any, name: str = name, box: Any = box) -> None:
                with page.clock.lock:
                    stage.layer(name, bool(box.value))
                    page.clock.go(page.clock.t)

            box.on_update(changed)

    def show(t: float) -> None:
        frame = frame_at(shown, kin, t)
        stage.show(frame)
        page.head.content = charts.clock(shown, frame)

    page.watch(show)
    page.span(shown.duration, shown.events())
    return page

"""Downloads of a page: the report, a picture, a video."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

from clamber.errors import ClamberError
from clamber.execution.simulation import Rollout
from clamber.planning.records import Plan
from clamber.show.film import skeleton_of_plan, video
from clamber.show.page import Page, Work
from clamber.show.report import REPORT, write_report

RENDER_SECONDS = 60.0  # [s] that a browser is waited for


class Handout:
    """Buttons that make a file and hand it to the browser which asked for it."""

    def __init__(
        self,
        page: Page,
        folder: Path,
        shown: Callable[[], tuple[Plan, Rollout | None]] | None,
    ) -> None:
        """Add the buttons to the panel.

        Args:
            page: With the panel.
            folder: Of the run, which the report is of.
            shown: What is on the page at present; None: nothing that could be drawn.
        """
        self._page, self._folder, self._shown = page, folder, shown
        self._add("Report: plots, tables, criteria", self._report, "report")
        if shown is not None:
            self._add("Picture of this view", self._picture, "draw")
            self._add("Video", self._video, "video")
        self._work = Work(page.server.gui)

    def _add(self, label: str, make: Callable[[Any, Path], Path], stage: str) -> None:
        """A button that makes a file; the stage is what there is to wait for."""
        button = self._page.server.gui.add_button(label)

        @button.on_click
        def _(event: Any) -> None:
            if event.client is not None:
                self._work.do(lambda: self._send(event.client, make), stage)

    def _send(self, client: Any, make: Callable[[Any, Path], Path]) -> str:
        """Make a file, and hand it out under the name of the run."""
        with tempfile.TemporaryDirectory() as there:
            file = make(client, Path(there))
            name = f"{self._folder.resolve().name}{file.suffix}"
            client.send_file_download(name, file.read_bytes(), save_immediately=True)
        return f"Downloaded as {name}"

    def _report(self, _: Any, there: Path) -> Path:
        return write_report(self._folder, out=there / REPORT).file

    def _picture(self, client: Any, there: Path) -> Path:
        """As the browser shows it, on a transparent background."""
        height, width = client.camera.image_height, client.camera.image_width
        try:
            seen = client.get_render(
                height, width, transport_format="png", timeout=RENDER_SECONDS
            )
        except RuntimeError as e:  # the tab has been closed
            raise ClamberError(str(e)) from e
        file = there / "view.png"
        Image.fromarray(seen).save(file)
        return file

    def _video(self, _: Any, there: Path) -> Path:
        """Video of the simulation, as `clamber render --video` draws it."""
        assert self._shown is not None
        plan, rollout = self._shown()
        if rollout is None:
            raise ClamberError("No video: this plan has not been run in physics.")
        person = skeleton_of_plan(plan)
        return video(plan, rollout, there, skeleton=person, report=self._work.report)

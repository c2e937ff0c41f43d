"""A page of the live view, open in a browser, and what is seen of it.

Judged by pixels: of COMAN's colours only its orange is nowhere else in the scene, and
only a recording's person is of its blue.
"""

from __future__ import annotations

import contextlib
import io
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clamber.show.live import open_view

SIZE = {"width": 900, "height": 620}
PATIENCE = 60.0  # [s] that something is waited for, on a busy machine, and as many
LOOKS = 30  # looks at least: a picture may take it seconds
SCENE = {"x": 0, "y": 0, "width": 520, "height": 620}  # beside the panel
# Where a point of the world is on the screen [px]; three.js has y up, we have z.
ON_SCREEN = """([name, x, y, z]) => {
  const m = window.__viserMutable, camera = m.camera;
  const p = camera.position.clone().set(x, y, z);
  p.applyMatrix4(m.nodeRefFromName[name].matrixWorld).project(camera);
  const b = m.canvas.getBoundingClientRect();
  return [b.left + (p.x + 1) / 2 * b.width, b.top + (1 - p.y) / 2 * b.height] }"""


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A page, the browser's tab on it, and what that has complained of."""

    page: Any
    tab: Any
    complaints: list[str]

    def until(self, met: Callable[[], Any], told: object = "") -> None:
        end, looks = time.monotonic() + PATIENCE, 0
        while looks < LOOKS or time.monotonic() < end:
            if met():
                return
            self.tab.wait_for_timeout(50)
            looks += 1
        pytest.fail(f"it never came: {told}")

    def row(self, label: str) -> Any:
        """What belongs to a label of the panel."""
        found = self.tab.locator("label", has_text=re.compile(f"^{label}$")).first
        return found.locator("xpath=../../..").locator("input").first

    def switch(self, label: str, on: bool) -> None:
        if self.row(label).is_checked() != on:
            self.row(label).click()

    def click(self, button: str) -> None:
        self.tab.get_by_role("button", name=button, exact=True).click()

    def folder(self, title: str) -> None:
        """Open a folder of the panel, or close it."""
        self.tab.get_by_text(title, exact=True).first.click()
        self.tab.wait_for_timeout(400)

    def choose(self, label: str, option: str) -> None:
        """One of what a list of the panel has."""
        self.row(re.escape(label)).click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def picture(self, clip: dict[str, int] | None = None) -> np.ndarray:
        """(height, width, 3) of the scene."""
        shot = self.tab.screenshot(clip=clip or SCENE)
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

    def still(self) -> np.ndarray:
        """The picture, once it changes no more."""
        before = self.picture()
        for _ in range(40):
            self.tab.wait_for_timeout(200)
            now = self.picture()
            if np.array_equal(before, now):
                return now
            before = now
        pytest.fail("it does not come to rest")

    def orange(self) -> int:
        """Pixels of the robot."""
        return int(np.sum(orange_in(self.picture())))

    def blue(self) -> int:
        """Pixels of the person."""
        r, g, b = np.moveaxis(self.picture(), 2, 0)
        return int(np.sum((b > 1.2 * r) & (b > 1.05 * g) & (r > 60)))


def orange_in(picture: np.ndarray) -> np.ndarray:
    """(height, width) bool, where a picture is of the robot's colour."""
    r, g, b = np.moveaxis(picture, 2, 0)
    return (r > 100) & (r > 2.5 * b) & (r > 1.3 * g)


@contextlib.contextmanager
def served(
    browser: Any,
    *sources: Any,
    query: str = "",
    size: dict[str, int] | None = None,
    ready: str = 'text="speed"',
):
    """A page of some sources in a tab, which asks for nothing from elsewhere."""
    source, *beside = sources or (None,)
    page, complaints = open_view(source, beside=beside, port=18090), []
    tab = browser.new_context(viewport=size or SIZE).new_page()
    tab.set_default_timeout(40_000)
    tab.on("pageerror", lambda e: complaints.append(str(e)))
    tab.on("console", lambda m: m.type == "error" and complaints.append(m.text))

    def allow(route: Any) -> None:
        if route.request.url.startswith((page.url, "blob:", "data:")):
            route.continue_()
        else:
            complaints.append(route.request.url)
            route.abort()

    try:
        tab.route("**/*", allow)
        tab.goto(page.url + query)
        tab.wait_for_selector(ready, state="attached")
        tab.add_style_tag(content=".mantine-Notification-root {display: none}")
        opened = Opened(page=page, tab=tab, complaints=complaints)
        yield opened
        if complaints:
            pytest.fail(str(complaints))
        tab.context.close()
    finally:
        page.close()

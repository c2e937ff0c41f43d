"""Take a picture of a run as `clamber view` or its report shows it, with Chromium.

python examples/view_picture.py RUN view.jpg [light|dark] [1280x800]
python examples/view_picture.py RUN/report.html report.jpg [light|dark] [950x810]

An empty RUN is the page on which a climb begins.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from clamber import open_view

FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
SHARE = 0.56  # of the run's time: hands and feet are loaded


def switch(tab: Page, label: str) -> None:
    """Tick a checkbox of the panel."""
    row = tab.locator("label", has_text=label).first.locator("xpath=../../..")
    row.locator("input").check()


@contextlib.contextmanager
def view(tab: Page, run: str, scheme: str, wide: bool) -> Iterator[None]:
    """Open the run, show the recording and go to the middle."""
    page = open_view(run or None)
    try:
        tab.goto(page.url + ("/?darkMode" if scheme == "dark" else ""))
        tab.wait_for_selector('text="speed"' if run else 'text="Climb"')
        tab.add_style_tag(content=".mantine-Notification-root {display: none}")
        tab.wait_for_timeout(3000)
        if run and wide:
            tab.get_by_text("Show", exact=True).click()
            switch(tab, "recording")
            switch(tab, "shadows")
            tab.get_by_role("button", name="corner", exact=True).click()
        tab.wait_for_timeout(1000)
        if run:
            page.clock.go(SHARE * page.clock.end)
        tab.wait_for_timeout(4000)
        yield
    finally:
        page.close()


@contextlib.contextmanager
def report(tab: Page, file: str) -> Iterator[None]:
    """Open the file and go to the middle."""
    tab.goto(Path(file).resolve().as_uri())
    tab.evaluate("share => go(share * END)", SHARE)
    tab.wait_for_timeout(4000)
    yield


def main(run: str, out: str, scheme: str = "light", size: str = "1280x800") -> None:
    """Take the picture."""
    width, height = (int(x) for x in size.split("x"))
    with sync_playwright() as p:
        chromium = shutil.which("chromium")
        browser = p.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page(
            viewport={"width": width, "height": height},
            color_scheme="dark" if scheme == "dark" else "light",
        )
        tab.set_default_timeout(120_000)
        is_report = run.endswith(".html")
        opened = report(tab, run) if is_report else view(tab, run, scheme, width > 600)
        with opened:
            tab.screenshot(path=out, type="jpeg", quality=72)
        browser.close()


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Take a picture of a run as `clamber view` shows it, with a headless Chromium.

python examples/view_picture.py RUN view.jpg [light|dark] [1280x800]

An empty RUN is the page on which a climb begins.
"""

from __future__ import annotations

import shutil
import sys

from playwright.sync_api import Page, sync_playwright

from clamber import open_view

FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]


def switch(tab: Page, label: str) -> None:
    """Tick a checkbox of the panel."""
    row = tab.locator("label", has_text=label).first.locator("xpath=../../..")
    row.locator("input").check()


def main(run: str, out: str, scheme: str = "light", size: str = "1280x800") -> None:
    """Open the run, show the recording, go to the middle and take the picture."""
    width, height = (int(x) for x in size.split("x"))
    page = open_view(run or None)
    with sync_playwright() as p:
        browser = p.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.set_default_timeout(120_000)
        tab.goto(page.url + ("/?darkMode" if scheme == "dark" else ""))
        tab.wait_for_selector('text="speed"' if run else 'text="Climb"')
        tab.add_style_tag(content=".mantine-Notification-root {display: none}")
        tab.wait_for_timeout(3000)
        if run and width > 600:
            tab.get_by_text("Show", exact=True).click()
            switch(tab, "recording")
            switch(tab, "shadows")
            tab.get_by_role("button", name="corner", exact=True).click()
        tab.wait_for_timeout(1000)
        if run:
            page.clock.go(0.56 * page.clock.end)
        tab.wait_for_timeout(4000)
        tab.screenshot(path=out, type="jpeg", quality=72)
        browser.close()
    page.close()


if __name__ == "__main__":
    main(*sys.argv[1:])

"""How soon a run is seen in the browser, and how many of its states are drawn a second.

    python benchmarks/bench_view.py RUN [--size 1280x800] [--seconds 5] [--rounds 3]

Opens the report and the view of a run folder in headless Chromium; without a graphics
card its software renderer draws. Both are timed from the request: until the page has
loaded, and until the first picture with the robot in it (COMAN: it is told by its
orange; the time of that screenshot counts). Making them is timed apart.

Then the view plays. Counted in the page: frames that were rendered, and among them
those in which the robot's bodies were not where they were in the one before. Medians of
the rounds. On an idle machine, or the figures are the machine's.
"""

from __future__ import annotations

import argparse
import io
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

import clamber
from clamber.show.live import LAYERS

FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
SETTLED = 4.0  # [s] until shaders are compiled
ROBOT = 300  # pixels of orange
# Looked at once for each frame of the browser: whether the renderer has run, and
# whether the nodes of the robot are where they were.
COUNT = """async seconds => {
  const info = window.__viserTestpoints.rendererInfo;
  const nodes = window.__viserMutable.nodeRefFromName;
  let drawn = info.render.frame, last = "", triangles = 0;
  const out = {frames: 0, states: 0}, begin = performance.now();
  return await new Promise(done => {
    const look = () => {
      if (info.render.frame !== drawn) {
        out.frames += info.render.frame - drawn;
        drawn = info.render.frame;
        triangles = info.render.triangles;
        let now = "";
        for (const name in nodes)
          if (name.includes("/robot") && nodes[name])
            now += nodes[name].matrixWorld.elements.map(x => x.toFixed(6)).join();
        if (now !== last) out.states++;
        last = now;
      }
      out.seconds = (performance.now() - begin) / 1000;
      if (out.seconds < seconds) requestAnimationFrame(look);
      else done({...out, triangles});
    };
    requestAnimationFrame(look);
  });
}"""


def opening(browser: Browser, url: str, size: str) -> tuple[float, float]:
    """[s] from the request until a page has loaded, and until the robot is seen."""
    width, height = (int(x) for x in size.split("x"))
    tab: Any = browser.new_page(viewport={"width": width, "height": height})
    tab.set_default_timeout(120_000)
    try:
        begin = time.perf_counter()
        tab.goto(url)
        loaded = time.perf_counter() - begin
        while not is_seen(tab.screenshot()):
            pass
        return loaded, time.perf_counter() - begin
    finally:
        tab.close()


def is_seen(screenshot: bytes) -> bool:
    """Whether the robot is in a picture."""
    picture = np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB")).astype(int)
    r, g, b = np.moveaxis(picture, 2, 0)
    return bool(np.sum((r > 100) & (r > 2.5 * b) & (r > 1.3 * g)) > ROBOT)


def openings(browser: Browser, run: str, size: str, rounds: int) -> None:
    """How long report and view take to be made, to load and to show the robot."""
    print(f"{'':20}{'made [s]':>9}{'loaded':>9}{'robot':>9}")
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        report = clamber.write_report(run, out=Path(folder) / "report.html").file
        made = time.perf_counter() - begin
        seen = [opening(browser, report.as_uri(), size) for _ in range(rounds)]
        row = "".join(f"{median(x):9.1f}" for x in zip(*seen, strict=True))
        megabytes = report.stat().st_size / 1e6
        print(f"{'report':20}{made:9.1f}{row}   {megabytes:.1f} MB", flush=True)
    begin = time.perf_counter()
    page = clamber.open_view(run, port=8480)
    made = time.perf_counter() - begin
    try:
        seen = [opening(browser, page.url, size) for _ in range(rounds)]
    finally:
        page.close()
    row = "".join(f"{median(x):9.1f}" for x in zip(*seen, strict=True))
    print(f"{'view':20}{made:9.1f}{row}", flush=True)


def measure(
    browser: Browser, run: str, size: str, seconds: float, layers: dict[str, bool]
) -> dict[str, float]:
    """Play a run from the middle, with some layers switched, and count."""
    width, height = (int(x) for x in size.split("x"))
    page = clamber.open_view(run, port=8480)
    tab: Any = browser.new_page(viewport={"width": width, "height": height})
    tab.set_default_timeout(120_000)
    try:
        tab.goto(page.url)
        tab.wait_for_selector('text="speed"')
        tab.get_by_text("Show", exact=True).click()
        for name, on in layers.items():
            row = tab.get_by_text(name, exact=True).locator("xpath=../../..")
            row.locator("input").first.set_checked(on, force=True)
        page.clock.go(0.4 * page.clock.end, playing=True)
        tab.wait_for_timeout(1000 * SETTLED)
        counted = tab.evaluate(COUNT, seconds)
        span = counted["seconds"]
        rates = {k: counted[k] / span for k in ("states", "frames")}
        return rates | {"triangles": counted["triangles"]}
    finally:
        tab.close()
        page.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run")
    parser.add_argument("--size", default="1280x800")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        print("no chromium here: nothing is measured")
        return
    kinds = {
        "run, as it opens": {},
        "robot alone": {name: False for name, on in LAYERS.items() if on},
        "shadows": {"shadows": True},
        "all layers": {name: True for name, on in LAYERS.items() if not on},
    }
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium, args=FLAGS)
        openings(browser, asked.run, asked.size, asked.rounds)
        print(f"{'':20}{'states/s':>9}{'frames/s':>9}{'triangles':>11}")
        for name, layers in kinds.items():
            rounds = [
                measure(browser, asked.run, asked.size, asked.seconds, layers)
                for _ in range(asked.rounds)
            ]
            m = {k: median(r[k] for r in rounds) for k in rounds[0]}
            row = f"{m['states']:9.1f}{m['frames']:9.1f}{m['triangles']:11.0f}"
            print(f"{name:20}{row}", flush=True)
        browser.close()


if __name__ == "__main__":
    main()

"""How many states of a run the browser draws in a second, and where the time goes.

    python benchmarks/bench_view.py [RUN] [--size 1280x800] [--seconds 5] [--rounds 3]

Plays a run (by default the built-in climb, planned and simulated first) in headless
Chromium, which has no GPU here: its software renderer draws. Counted in the page, while
it plays: frames that were rendered, and among them those in which the robot's bodies
were not where they were in the one before. An empty viser page of the same size, in
which a single node moves, shows what the renderer can do at most at that moment: all
are measured in turn, and medians of the rounds shown. The columns in ms are processor
time a frame. On an idle machine, or the figures are the machine's.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import Any

import viser
from playwright.sync_api import Browser, sync_playwright

import clamber
from clamber.show.view.page import FRAMES_A_SECOND
from clamber.show.view.stage import LAYERS

FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
SETTLED = 4.0  # [s] until shaders are compiled and the resolution has been adapted
PORT = 8480
# What has been drawn is looked at once for each frame of the browser: how often the
# renderer has run, and whether the nodes under `root` are where they were.
COUNT = """async ([seconds, root]) => {
  const info = window.__viserTestpoints.rendererInfo;
  const nodes = window.__viserMutable.nodeRefFromName;
  let drawn = info.render.frame, last = "", calls = 0, triangles = 0;
  const out = {frames: 0, states: 0}, begin = performance.now();
  return await new Promise(done => {
    const look = () => {
      if (info.render.frame !== drawn) {
        out.frames += info.render.frame - drawn;
        drawn = info.render.frame;
        calls = info.render.calls; triangles = info.render.triangles;
        let now = "";
        for (const name in nodes)
          if (name.includes(root) && nodes[name])
            now += nodes[name].matrixWorld.elements.map(x => x.toFixed(6)).join();
        if (now !== last) out.states++;
        last = now;
      }
      out.seconds = (performance.now() - begin) / 1000;
      if (out.seconds < seconds) requestAnimationFrame(look);
      else done({...out, calls, triangles});
    };
    requestAnimationFrame(look);
  });
}"""
SIZE = """(() => { const c = [...document.querySelectorAll("canvas")]
  .find(c => c.dataset.engine); return `${c.width}x${c.height}` })()"""
RENDERER = """(() => { const g = document.createElement("canvas").getContext("webgl2");
  const e = g.getExtension("WEBGL_debug_renderer_info");
  return g.getParameter(e ? e.UNMASKED_RENDERER_WEBGL : g.RENDERER) })()"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Rates in 1/s, times in ms of a processor a frame."""

    states: float
    frames: float
    sent: float
    drawing: float
    page: float
    server: float
    calls: int
    triangles: int
    canvas: str


def processes() -> dict[int, str]:
    """Kind of each process of the browser that was started from here."""
    parents: dict[int, int] = {}
    kinds: dict[int, str] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                stat = (entry / "stat").read_text().rsplit(")", 1)[1].split()
                words = (entry / "cmdline").read_text().replace("\0", " ").split()
                parents[int(entry.name)] = int(stat[1])
                kind = [w[7:] for w in words if w.startswith("--type=")]
                kinds[int(entry.name)] = kind[0] if kind else ""
    own = {}
    for process in parents:
        above = process
        while above in parents and above != os.getpid():
            above = parents[above]
        if above == os.getpid():
            own[process] = kinds[process]
    return own


def processor_time(process: int) -> float:
    """[s]."""
    with contextlib.suppress(OSError):
        text = Path(f"/proc/{process}/stat").read_text()
        used = text.rsplit(")", 1)[1].split()
        return (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def measure(
    browser: Browser,
    url: str,
    size: tuple[int, int],
    seconds: float,
    *,
    root: str,
    play: Callable[[Any], None],
    sent: Callable[[], int],
) -> Measured:
    """Open a page, have it play, and count."""
    tab = browser.new_page(viewport={"width": size[0], "height": size[1]})
    tab.set_default_timeout(120_000)
    tab.goto(url)
    tab.wait_for_function("window.__viserTestpoints !== undefined")
    play(tab)
    tab.wait_for_timeout(1000 * SETTLED)
    kinds = processes()
    used = {p: processor_time(p) for p in kinds}
    mine, messages = time.process_time(), sent()
    counted = tab.evaluate(COUNT, [seconds, root])
    mine, messages = time.process_time() - mine, sent() - messages
    took = {"gpu-process": 0.0, "renderer": 0.0}
    for p, kind in kinds.items():
        if kind in took:
            took[kind] += processor_time(p) - used[p]
    canvas = tab.evaluate(SIZE)
    tab.close()
    span, frames = counted["seconds"], max(1, counted["frames"])
    return Measured(
        states=counted["states"] / span,
        frames=counted["frames"] / span,
        sent=messages / span,
        drawing=1e3 * took["gpu-process"] / frames,
        page=1e3 * took["renderer"] / frames,
        server=1e3 * mine / frames,
        calls=counted["calls"],
        triangles=counted["triangles"],
        canvas=canvas,
    )


@contextlib.contextmanager
def empty_page() -> Iterator[tuple[str, Callable[[], int]]]:
    """A viser page with nothing but a node that moves; how often it has."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(port=PORT, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.add_slider("time", 0.0, 1.0, 0.1, 0.0)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(400)
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(False)
    node = server.scene.add_frame("/moves", show_axes=False)
    stopped, count = threading.Event(), [0]

    def move() -> None:
        while not stopped.wait(1.0 / FRAMES_A_SECOND):
            count[0] += 1
            node.position = (0.001 * (count[0] % 100), 0.0, 0.0)

    mover = threading.Thread(target=move)
    mover.start()
    try:
        yield f"http://localhost:{server.get_port()}", lambda: count[0]
    finally:
        stopped.set()
        mover.join()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def play_run(
    browser: Browser,
    run: Path,
    size: tuple[int, int],
    seconds: float,
    layers: dict[str, bool],
) -> Measured:
    """Play a run from the middle, with some layers switched."""
    page = clamber.open_view(run, port=PORT)
    count = [0]

    def tell(_: float) -> None:
        count[0] += 1

    def play(tab: Any) -> None:
        tab.wait_for_selector("text=go to", state="attached")
        tab.get_by_role("tab", name="Show").click()
        for name, on in layers.items():
            row = tab.locator("label", has_text=name).first.locator("xpath=../../..")
            if row.locator("input").is_checked() != on:
                row.locator("input").click()
        tab.get_by_role("tab", name="Stances").click()
        page.clock.go(0.4 * page.clock.end)
        tab.click("button:has-text('play')")

    page.watch(tell)
    try:
        return measure(
            browser,
            page.url,
            size,
            seconds,
            root="/robot",
            play=play,
            sent=lambda: count[0],
        )
    finally:
        page.close()


def middle(rounds: list[Measured]) -> Measured:
    """Of each figure the median."""
    return replace(
        rounds[0],
        **{
            x.name: median(getattr(m, x.name) for m in rounds)
            for x in fields(Measured)
            if x.name != "canvas"
        },
    )


def show(name: str, m: Measured) -> None:
    """A line of the table."""
    print(
        f"{name:24}{m.states:9.1f}{m.frames:9.1f}{m.sent:8.1f}{m.drawing:9.1f}"
        f"{m.page:7.1f}{m.server:8.1f}{m.calls:7.0f}{m.triangles:11.0f}  {m.canvas}",
        flush=True,
    )


def climbed(folder: Path) -> Path:
    """The built-in climb, planned and simulated."""
    sequence = clamber.detect_contacts(clamber.load_demo("climb"))
    scene = clamber.Scene.from_height(0.275)
    made = clamber.plan(sequence, clamber.load_robot("coman"), scene)
    rollout = clamber.simulate(made)
    clamber.save_plan(made, folder)
    clamber.save_rollout(made, rollout, folder)
    return folder


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", nargs="?")
    parser.add_argument("--size", default="1280x800")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    width, height = (int(x) for x in asked.size.split("x"))
    size, seconds = (width, height), asked.seconds
    chromium = shutil.which("chromium")
    if chromium is None:
        print("no chromium here: nothing is measured")
        return
    with tempfile.TemporaryDirectory() as made, sync_playwright() as p:
        run = Path(asked.run) if asked.run else climbed(Path(made))
        browser = p.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page()
        print(f"{tab.evaluate(RENDERER)}, window {asked.size}")
        tab.close()
        print(
            f"{'':24}{'states/s':>9}{'frames/s':>9}{'sent/s':>8}{'draw ms':>9}"
            f"{'page':>7}{'server':>8}{'calls':>7}{'triangles':>11}  canvas"
        )
        bare = {name: False for name, on in LAYERS.items() if on}
        every = {name: True for name, on in LAYERS.items() if not on}
        kinds = {"run, as it opens": {}, "robot alone": bare, "all layers": every}
        found: dict[str, list[Measured]] = {}
        for _ in range(asked.rounds):
            with empty_page() as (url, count):
                m = measure(
                    browser,
                    url,
                    size,
                    seconds,
                    root="/moves",
                    play=lambda tab: None,
                    sent=count,
                )
            found.setdefault("empty viser page", []).append(m)
            for name, layers in kinds.items():
                m = play_run(browser, run, size, seconds, layers)
                found.setdefault(name, []).append(m)
        for name, rounds in found.items():
            show(name, middle(rounds))
        browser.close()


if __name__ == "__main__":
    main()

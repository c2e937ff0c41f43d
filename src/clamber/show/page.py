"""A page in the browser: server, panel, cameras and a clock that plays (viser).

All that changes what is shown goes through the clock's lock: callbacks come from a pool
of threads, the clock from one of its own.
"""

from __future__ import annotations

import contextlib
import html
import io
import math
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from clamber.errors import InputError
from clamber.show.renderer import PRESETS, Preset, View, frame_view
from clamber.show.report import write_report

FRAMES_A_SECOND = 30
PANEL_SECONDS = 0.2  # [s] between two states of the panel while it plays
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x", "8x")
SLIDER_STEP = 0.01  # [s]
STEP = 0.02  # [s] events nearer than this are where one is
PANEL_WIDTH, ASPECT = 360, 1.2  # [px]; of the picture beside it
PULLED_BACK = 1.15  # cameras stand so much farther than they must
PLAY, PAUSE, BACK, ON = "play", "pause", "< contact", "contact >"
SECTIONS, CELLS = (150, 157, 166), (176, 183, 192)  # of the ground, light and dark


class Clock:
    """Time that plays, is scrubbed and stepped, and what is told of it."""

    def __init__(self, show: Callable[[float], None]) -> None:
        """Nothing to show yet.

        Args:
            show: Called with each new time [s], one call at a time.
        """
        self.lock = threading.RLock()
        self.t, self.speed, self.playing = 0.0, 1.0, False
        self.begin, self.end, self.events = 0.0, 0.0, [0.0]
        self._show = show

    def span(self, begin: float, end: float, events: Sequence[float]) -> None:
        """What there is to play [s], and the times to step through."""
        with self.lock:
            self.begin, self.end, self.events = begin, end, sorted(events)
            self.go(self.t)

    def go(self, t: float, *, playing: bool = False) -> None:
        """Show a time."""
        with self.lock:
            self.t = min(max(t, self.begin), self.end)
            self.playing = playing
            self._show(self.t)

    def step(self, way: int) -> None:
        """To the next event, or the one before."""
        with self.lock:
            if way > 0:
                self.go(next((t for t in self.events if t > self.t + STEP), self.end))
            else:
                earlier = [t for t in self.events if t < self.t - STEP]
                self.go(earlier[-1] if earlier else self.begin)

    def toggle(self) -> None:
        """Play, from the beginning where it is at its end; or pause."""
        with self.lock:
            restart = not self.playing and self.t >= self.end
            starts = not self.playing and self.end > self.begin
            self.go(self.begin if restart else self.t, playing=starts)

    def advance(self, seconds: float) -> None:
        """Let so much time pass, where it plays."""
        with self.lock:
            if self.playing:
                t = self.t + seconds * self.speed
                self.go(t, playing=t < self.end)


class Page:
    """A server, its panel, cameras and clock; what is shown is told of each time."""

    def __init__(
        self,
        host: str,
        port: int,
        title: str,
        missing: list[str],
        notes: Sequence[str] = (),
    ) -> None:
        """Start serving; nothing is shown yet.

        Args:
            host: To listen on.
            port: From which on viser takes a free one.
            title: Of the panel.
            missing: A sentence for each thing that cannot be shown.
            notes: What else there is to say.

        Raises:
            InputError: There is no such address.
        """
        import viser

        self.host, self.wanted, self.missing = host, port, missing
        check_address(host, port)
        with _silent():
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.port = self.server.get_port()
        self.clock = Clock(self._tell)
        self._watchers: list[Callable[[float], str]] = []
        self._views: dict[Preset, View] = {}
        self._panel_next = 0.0
        self._stopped = threading.Event()
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        if missing or any(notes):
            gui.add_html(paragraphs((*missing, *(n for n in notes if n))))
        self._now = gui.add_html("")
        self._timeline()
        with gui.add_folder("Show", expand_by_default=False) as self.layers:
            self._surroundings()
        self._player = threading.Thread(target=self._play, daemon=True)
        self._player.start()

    @property
    def url(self) -> str:
        """Where the page is, from this machine."""
        name = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{self.port}"

    def __repr__(self) -> str:
        """Where it is."""
        return f"Page({self.url})"

    def _repr_html_(self) -> str:
        """The page itself, in a notebook."""
        look = "width: 100%; height: 600px; border: 0"
        return f'<iframe src="{self.url}" style="{look}"></iframe>'

    def close(self) -> None:
        """Stop serving."""
        self._stopped.set()
        self._player.join()
        with _silent():
            self.server.stop()

    def watch(self, show: Callable[[float], str]) -> None:
        """Have it show each new time [s], and return HTML of what there is to say."""
        self._watchers.append(show)

    def look(self, points: np.ndarray, yaw: float, fovy: float) -> None:
        """Have cameras take in points (n, 3) [m]: of a new browser, and the presets."""
        self._views = {
            name: frame_view(points, ASPECT, yaw=yaw, fovy=fovy, camera=name)
            for name in PRESETS
        }
        first, camera = self._views["corner"], self.server.initial_camera
        camera.position, camera.look_at = eye_of(first), first.lookat
        camera.up, camera.fov = (0.0, 0.0, 1.0), math.radians(first.fovy)

    def span(self, begin: float, end: float, events: Sequence[float]) -> None:
        """What there is to play [s], and the times to step through."""
        self._slider.min, self._slider.max = begin, max(end, begin + SLIDER_STEP)
        self.clock.span(begin, end, events)

    def add_report(self, folder: Path) -> None:
        """A button that hands out the report of a run."""
        button = self.server.gui.add_button("Report: plots, tables, criteria")

        @button.on_click
        def _(event: Any) -> None:
            with tempfile.TemporaryDirectory() as there:
                file = write_report(folder, out=Path(there) / "report.html").file
                name = f"{folder.resolve().name}.html"
                event.client.send_file_download(name, file.read_bytes())

    def _timeline(self) -> None:
        """Slider, buttons, speed and keys."""
        gui, clock = self.server.gui, self.clock
        self._slider = gui.add_slider("time [s]", 0.0, 1.0, SLIDER_STEP, 0.0)
        self._buttons = gui.add_button_group("step", (BACK, PLAY, ON))
        speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")

        @self._slider.on_update
        def _(event: Any) -> None:
            # Not what we set, nor what the browser says again, cut to its steps.
            t = float(self._slider.value)
            if event.client is not None and abs(t - clock.t) >= 2 * SLIDER_STEP:
                clock.go(t, playing=clock.playing)

        @self._buttons.on_click
        def _(_: Any) -> None:
            pressed = self._buttons.value
            if pressed in (PLAY, PAUSE):
                clock.toggle()
            else:
                clock.step(1 if pressed == ON else -1)

        @speed.on_update
        def _(_: Any) -> None:
            clock.speed = float(speed.value.removesuffix("x"))

        for key, label, act in (
            ("space", "Play or pause", clock.toggle),
            ("pagedown", "Next contact", lambda: clock.step(1)),
            ("pageup", "Previous contact", lambda: clock.step(-1)),
        ):
            command = gui.add_command(label, hotkey=cast(Any, key))
            command.on_trigger(lambda _, act=act: act())

    def _surroundings(self) -> None:
        """Lights, ground, cameras and theme."""
        gui, scene = self.server.gui, self.server.scene
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_hemisphere(
            "/lights/sky",
            sky_color=(255, 255, 255),
            ground_color=(170, 165, 160),
            intensity=2.2,
        )
        sun = scene.add_light_directional(
            "/lights/sun", intensity=2.2, position=(-1.5, -2.5, 4.0)
        )
        scene.add_grid(
            "/ground",
            8.0,
            8.0,
            cell_size=0.1,
            section_size=0.5,
            section_color=SECTIONS,
            cell_color=CELLS,
            fade_distance=9.0,
            shadow_opacity=0.25,
        )
        cameras = gui.add_button_group("camera", tuple(PRESETS))
        shadows = gui.add_checkbox("shadows", False)

        @cameras.on_click
        def _(event: Any) -> None:
            view = self._views.get(cast(Preset, cameras.value))
            if event.client is not None and view is not None:
                with event.client.atomic():
                    event.client.camera.position = eye_of(view)
                    event.client.camera.look_at = view.lookat

        @shadows.on_update
        def _(_: Any) -> None:
            sun.cast_shadow = shadows.value

    def _tell(self, t: float) -> None:
        """The scene follows each step of the clock, the panel some while it plays."""
        now = time.perf_counter()
        with self.server.atomic():
            said = [show(t) for show in self._watchers]
            self._buttons.options = (BACK, PAUSE if self.clock.playing else PLAY, ON)
            if not self.clock.playing or now >= self._panel_next:
                self._panel_next = now + PANEL_SECONDS
                self._slider.value = round(t, 2)
                self._now.content = "".join(said)

    def _play(self) -> None:
        """Let time pass, in steps of a frame, while somebody looks."""
        last = time.perf_counter()
        while not self._stopped.wait(1.0 / FRAMES_A_SECOND):
            now = time.perf_counter()
            if self.server.get_clients():
                self.clock.advance(min(now - last, 0.25))
            last = now


def check_address(host: str, port: int) -> None:
    """Whether this machine can listen there: viser would try on and on.

    Raises:
        InputError: It is no port, or the host is none of this machine.
    """
    if not 1 <= port <= 65535:
        raise InputError("a port from 1 to 65535", source="--port", value=port)
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
        family, kind, _, _, address = found[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as e:
        expected = f"an address of this machine ({e.strerror or e})"
        raise InputError(expected, source="--host", value=host) from e


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without what viser prints on its own: results are ours to print."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def paragraphs(texts: Sequence[str]) -> str:
    """Texts, which may come from a run folder, as HTML that is no markup of theirs."""
    lines = "".join(f'<p style="margin: 4px 0">{html.escape(x)}</p>' for x in texts)
    return f'<div style="font-size: 13px; padding: 0 12px">{lines}</div>'


def eye_of(view: View) -> np.ndarray:
    """(3,) where a camera stands [m]."""
    return view.lookat - PULLED_BACK * view.distance * view.axes[2]

"""The page: a server, its panel and the clock that plays.

All that changes what is shown goes through one lock: callbacks come from a pool of
threads, the clock from its own.
"""

from __future__ import annotations

import contextlib
import io as text_io
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import viser

from clamber.errors import InputError
from clamber.show.renderer import PRESETS, Preset, View, frame_view
from clamber.show.view import charts

FRAMES_A_SECOND = 45  # so that a browser that draws 30 has a new one for each
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x", "8x")
STEP = 0.02  # [s] events nearer than this are where one is
SLIDER_STEP = 0.01  # [s]
PORTS = 50  # tried, one after the other
PANEL_WIDTH = 400  # [px]
ASPECT = 1.2  # of the picture beside the panel
PULLED_BACK = 1.15  # cameras stand so much farther than they must
SHEET = 0.17  # of the distance that what is seen is moved up, over a panel below
GROUND, GROUND_SIZE, GROUND_CELL = "/ground", 6.0, 1.0  # [m]
GROUND_LINE = 0.005  # [m]
SECTIONS, CELLS = (176, 183, 192), (208, 213, 220)
DARK_SECTIONS, DARK_CELLS = (74, 80, 88), (46, 50, 56)
PLAY, PAUSE = "play", "pause"
BACK, ON = "< contact", "contact >"
PANEL_SECONDS = 0.2  # [s] between two states of the panel while it plays
DARK, FINE = "dark", "fine in motion"
AT_REST = 0.6  # [s] after which what has not moved is drawn finely
# What the browser wants is handed to the checkboxes: its own scheme; shadows and all
# faces in motion too, unless a processor draws: they take longer than all the rest.
# Where it does, it draws a quarter of the pixels while something moves: from the start.
_SET_RESOLUTION = (
    "const v=window.__viserTestpoints;"
    "if(window.clamberSoft&&v&&v.devSettings&&v.devSettings.set)"
    "v.devSettings.set({{fixedDpr:{}}});"
)
RESOLUTION = f'<img src="data:," style="display:none" onerror="{_SET_RESOLUTION}">'
COARSE, ALL_PIXELS = "0.5", "null"
WISHES = (
    '<img src="data:," style="display:none" onerror="'
    "const g=document.createElement('canvas').getContext('webgl2'),"
    "x=g&&g.getExtension('WEBGL_debug_renderer_info'),"
    "n=g?g.getParameter(x?x.UNMASKED_RENDERER_WEBGL:g.RENDERER):'none',"
    "lost=g&&g.getExtension('WEBGL_lose_context');"
    "if(lost)lost.loseContext();"
    "window.clamberSoft="
    "/swiftshader|llvmpipe|softpipe|software|basic render|none/i.test(n);"
    f"const wish={{'{DARK}':matchMedia('(prefers-color-scheme: dark)').matches,"
    f"'{FINE}':!window.clamberSoft}};"
    "for(const l of document.querySelectorAll('label'))"
    "if(wish[l.textContent.trim()]){"
    "let e=l;while(!e.querySelector('input'))e=e.parentElement;"
    "const i=e.querySelector('input');if(!i.checked)i.click()}"
    + _SET_RESOLUTION.format(COARSE)
    + "if(window.clamberSoft){this.nextElementSibling.style.display='block';"
    "for(const n of document.querySelectorAll('.mantine-Notification-root'))"
    "if(/Software WebGL/.test(n.textContent))n.querySelector('button').click()}"
    '"><div style="display:none">'
    + charts.block(
        '<p class="dim">Drawn without a graphics card: coarsely in motion, with all '
        "faces and shadows at rest.</p>"
    )
    + "</div>"
)


def free_port(host: str, port: int) -> int:
    """The first port from `port` on that nobody listens on.

    Raises:
        InputError: The host is none of this machine, or there is no free port.
    """
    if not 1 <= port <= 65535:
        raise InputError("a port from 1 to 65535", source="--port", value=port)
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            host, 0, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as e:
        raise InputError(
            f"an address of this machine ({e.strerror or e})",
            source="--host",
            value=host,
        ) from e
    for candidate in range(port, min(port + PORTS, 65536)):
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind((host, candidate))
                return candidate
    raise InputError(
        f"a port that is free, or one of the {PORTS - 1} after it",
        source="--port",
        value=port,
    )


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Without what viser prints on its own: results are ours to print."""
    with contextlib.redirect_stdout(text_io.StringIO()):
        yield


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

    def go(self, t: float) -> None:
        """Show a time."""
        with self.lock:
            self.t = min(max(t, self.begin), self.end)
            self._show(self.t)

    def step(self, way: int) -> None:
        """To the next event, or the one before; no longer playing."""
        with self.lock:
            self.playing = False
            if way > 0:
                later = [t for t in self.events if t > self.t + STEP]
                self.go(later[0] if later else self.end)
            else:
                earlier = [t for t in self.events if t < self.t - STEP]
                self.go(earlier[-1] if earlier else self.begin)

    def toggle(self) -> None:
        """Play, from the beginning where it is at its end; or pause."""
        with self.lock:
            if not self.playing and self.t >= self.end:
                self.go(self.begin)
            self.playing = not self.playing and self.end > self.begin
            self.go(self.t)

    def advance(self, seconds: float) -> None:
        """Let so much time pass, where it plays."""
        with self.lock:
            if not self.playing:
                return
            self.playing = self.t + seconds * self.speed < self.end
            self.go(self.t + seconds * self.speed)


@dataclass(eq=False, slots=True, kw_only=True)
class _Browser:
    """What one browser has of its own.

    Attributes:
        client: It.
        dark, fine: Its checkboxes.
        resolution: The element that sets it.
        lights: Nodes that stand in for those of all.
        moved: When something moved in it last [s].
        drawn_finely: It has shadows and all faces at present.
    """

    client: viser.ClientHandle
    dark: Any
    fine: Any
    resolution: Any
    lights: list[Any]
    moved: float
    drawn_finely: bool = False


class Page:
    """What all pages have: ground, cameras, timeline, themes; the server itself."""

    def __init__(self, host: str, port: int, title: str) -> None:
        """Start serving; nothing is shown yet.

        Args:
            host: To listen on.
            port: From which on a free one is taken.
            title: Of the panel.

        Raises:
            InputError: There is no such address, or no free port.
        """
        self.wanted = port
        self.missing: list[str] = []
        port = free_port(host, port)
        with silent():
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.host, self.port = host, self.server.get_port()
        self.clock = Clock(self._tell)
        self._views: dict[Preset, View] = {}
        self._watchers: list[Callable[[float], None]] = []
        self._panel_watchers: list[Callable[[float], None]] = []
        self._panel_next = 0.0
        self._refiners: list[Callable[[viser.ClientHandle, bool], None]] = []
        self._browsers: dict[int, _Browser] = {}
        self._told = (math.nan, False)
        self._stopped = threading.Event()
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_hemisphere(
            "/lights/sky",
            sky_color=(255, 255, 255),
            ground_color=(170, 165, 160),
            intensity=2.2,
        )
        _surroundings(scene, dark=False, fine=False)
        gui.add_html(charts.STYLE)
        self.head = gui.add_html("")
        self._timeline()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._forget)
        self._player = threading.Thread(target=self._play, daemon=True)
        self._player.start()

    @property
    def url(self) -> str:
        """Where the page is, from this machine."""
        wild = self.host in ("0.0.0.0", "::", "")
        name = "localhost" if wild else self.host
        return (
            f"http://[{name}]:{self.port}"
            if ":" in name
            else f"http://{name}:{self.port}"
        )

    def close(self) -> None:
        """Stop serving."""
        self._stopped.set()
        self._player.join()
        with silent():
            self.server.stop()

    def watch(self, tell: Callable[[float], None], *, panel: bool = False) -> None:
        """Have it called with each new time [s]; with fewer where it is for the panel.

        The panel is told of every time at which the clock stands still.
        """
        (self._panel_watchers if panel else self._watchers).append(tell)

    def look(self, view: Callable[[Preset], View]) -> None:
        """Where cameras begin from now on, and where the buttons take them."""
        self._views = {name: view(name) for name in PRESETS}
        first = self._views["corner"]
        camera = self.server.initial_camera
        camera.position, camera.look_at = eye_of(first), first.lookat
        camera.up, camera.fov = (0.0, 0.0, 1.0), np.radians(first.fovy)

    # The panel.

    def _timeline(self) -> None:
        """Slider, buttons, speed, and the field that clicks in tables write into."""
        gui, clock = self.server.gui, self.clock
        self._slider = gui.add_slider("time [s]", 0.0, 1.0, SLIDER_STEP, 0.0)
        self._buttons = gui.add_button_group("step", (BACK, PLAY, ON))
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")
        self._go_to = gui.add_text(charts.GO_TO, "")

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is None:  # our own
                return
            with clock.lock:
                t = float(self._slider.value)
                # Nor ours, which the browser says again, cut to its steps.
                if abs(t - clock.t) >= 2 * SLIDER_STEP:
                    clock.go(t)

        @self._buttons.on_click
        def _(_: Any) -> None:
            pressed = self._buttons.value
            if pressed in (PLAY, PAUSE):
                clock.toggle()
            else:
                clock.step(1 if pressed == ON else -1)

        for key, label, act in (
            ("space", "Play or pause", clock.toggle),
            ("pagedown", "Next contact", lambda: clock.step(1)),
            ("pageup", "Previous contact", lambda: clock.step(-1)),
        ):
            command = gui.add_command(label, hotkey=cast(Any, key))
            command.on_trigger(lambda _, act=act: act())

        @self._speed.on_update
        def _(_: Any) -> None:
            clock.speed = float(self._speed.value.removesuffix("x"))

        @self._go_to.on_update
        def _(event: Any) -> None:
            if event.client is None:
                return
            text = str(self._go_to.value)
            with contextlib.suppress(ValueError):
                t = float(text.removeprefix(charts.CLICKED))
                with clock.lock:
                    clock.playing = False
                    clock.go(t)
            if text.startswith(charts.CLICKED):
                self._go_to.value = ""

    def _welcome(self, client: viser.ClientHandle) -> None:
        """What each browser has of its own: theme, shadows and faces."""
        own = _Browser(
            client=client,
            dark=client.gui.add_checkbox(DARK, False, order=1e9),
            fine=client.gui.add_checkbox(FINE, False, order=1e9 + 1),
            resolution=client.gui.add_html("", order=1e9 + 3),
            lights=[],
            moved=time.perf_counter(),
        )
        client.gui.add_html(WISHES, order=1e9 + 2)
        if self._views and client.camera.image_width < client.camera.image_height:
            self.point(client, "corner")

        @own.dark.on_update
        def _(_: Any) -> None:
            client.gui.configure_theme(
                dark_mode=own.dark.value, show_logo=False, show_share_button=False
            )
            with self.clock.lock:
                _light(own)

        @own.fine.on_update
        def _(_: Any) -> None:
            if own.fine.value:
                with self.clock.lock:
                    self._draw(own, True)

        @client.camera.on_update
        def _(_: Any) -> None:
            with self.clock.lock:
                self._moves(own)

        with self.clock.lock:
            self._browsers[client.client_id] = own

    def _forget(self, client: viser.ClientHandle) -> None:
        with self.clock.lock:
            self._browsers.pop(client.client_id, None)

    def moves(self) -> None:
        """Something moves: browsers draw it in time, and finely when it is at rest."""
        with self.clock.lock:
            for own in self._browsers.values():
                self._moves(own)

    def _moves(self, own: _Browser) -> None:
        own.moved = time.perf_counter()
        if own.drawn_finely and not own.fine.value:
            self._draw(own, False)

    def _rests(self) -> None:
        """Have browsers in which nothing moves any more draw finely."""
        now = time.perf_counter()
        with self.clock.lock:
            for own in self._browsers.values():
                if not own.drawn_finely and now - own.moved > AT_REST:
                    self._draw(own, True)

    def _draw(self, own: _Browser, finely: bool) -> None:
        """With shadows, all faces and pixels, or without."""
        if own.drawn_finely == finely:
            return
        own.drawn_finely = finely
        with own.client.atomic():
            own.resolution.content = RESOLUTION.format(ALL_PIXELS if finely else COARSE)
            _light(own)
            for tell in self._refiners:
                tell(own.client, finely)

    @property
    def fine(self) -> list[viser.ClientHandle]:
        """Browsers that draw all faces at present."""
        return [x.client for x in self._browsers.values() if x.drawn_finely]

    def on_fine(self, tell: Callable[[viser.ClientHandle, bool], None]) -> None:
        """Have it called when one of them begins or ceases to."""
        self._refiners.append(tell)

    def add_cameras(self) -> None:
        """Buttons for the presets."""
        buttons = self.server.gui.add_button_group("camera", tuple(PRESETS))

        @buttons.on_click
        def _(event: Any) -> None:
            if event.client is not None:
                self.point(event.client, cast(Preset, buttons.value))

    def point(self, client: viser.ClientHandle, preset: Preset) -> None:
        """Take a browser's camera to a preset."""
        view = self._views[preset]
        eye, at, camera = eye_of(view), view.lookat, client.camera
        if camera.image_width < camera.image_height:  # upright, the panel below
            eye = at + (eye - at) * ASPECT * camera.image_height / camera.image_width
            drop = SHEET * float(np.linalg.norm(eye - at)) * view.axes[1]
            eye, at = eye - drop, at - drop
        with client.atomic():
            camera.position, camera.look_at = eye, at

    # Time.

    def span(self, begin: float, end: float, events: Sequence[float]) -> None:
        """What there is to play [s], and the times to step through."""
        self._slider.min, self._slider.max = begin, max(end, begin + SLIDER_STEP)
        self.clock.span(begin, end, events)

    def _tell(self, t: float) -> None:
        """The scene follows each step of the clock, the panel some while it plays."""
        now = time.perf_counter()
        panel = not self.clock.playing or now >= self._panel_next
        if (t, self.clock.playing) != self._told:
            self._told = (t, self.clock.playing)
            self.moves()
        with self.server.atomic():
            for tell in self._watchers:
                tell(t)
            self._buttons.options = (BACK, PAUSE if self.clock.playing else PLAY, ON)
            if panel:
                self._panel_next = now + PANEL_SECONDS
                self._slider.value = round(t, 2)
                for tell in self._panel_watchers:
                    tell(t)

    def _play(self) -> None:
        """Let time pass, in steps of a frame, while somebody looks."""
        frame = 1.0 / FRAMES_A_SECOND
        last = time.perf_counter()
        while not self._stopped.wait(max(0.001, last + frame - time.perf_counter())):
            now = time.perf_counter()
            if self.server.get_clients():
                self.clock.advance(min(now - last, 0.25))
                self._rests()
            last = now


def _light(own: _Browser) -> None:
    """Lights and ground of a browser."""
    while own.lights:
        own.lights.pop().remove()
    dark, fine = own.dark.value, own.drawn_finely
    own.lights += _surroundings(own.client.scene, dark=dark, fine=fine)


def _surroundings(scene: viser.SceneApi, *, dark: bool, fine: bool) -> list[Any]:
    """Sun and ground; where it is fine, shadows too, and a ground that has them."""
    sections, cells = (DARK_SECTIONS, DARK_CELLS) if dark else (SECTIONS, CELLS)
    sun = scene.add_light_directional(
        "/lights/sun", intensity=2.2, cast_shadow=fine, position=(-1.5, -2.5, 4.0)
    )
    if fine:
        ground = scene.add_grid(
            GROUND,
            GROUND_SIZE,
            GROUND_SIZE,
            cell_size=GROUND_CELL / 10,
            section_size=GROUND_CELL / 2,
            cell_color=cells,
            section_color=sections,
            fade_distance=9.0,
            shadow_opacity=0.4 if dark else 0.2,
        )
    else:
        vertices, faces = _ground_lines()
        ground = scene.add_mesh_simple(
            GROUND,
            vertices,
            faces,
            color=sections,
            cast_shadow=False,
            receive_shadow=False,
        )
    return [sun, ground]


def _ground_lines() -> tuple[np.ndarray, ...]:
    """Vertices and triangles of strips on the ground, both ways."""
    half, wide = GROUND_SIZE / 2, GROUND_LINE / 2
    at = np.arange(-half, half + 0.5 * GROUND_CELL, GROUND_CELL)
    corners = [(-wide, -half), (wide, -half), (wide, half), (-wide, half)]
    one, zero = np.ones_like(at), np.zeros_like(at)
    strips = np.stack([[at + x, y * one, zero] for x, y in corners]).transpose(2, 0, 1)
    across = strips[:, ::-1, [1, 0, 2]]
    first = 4 * np.arange(2 * len(at))[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]])
    return np.concatenate([strips, across]).reshape(-1, 3), faces.reshape(-1, 3)


def eye_of(view: View) -> np.ndarray:
    """(3,) where a camera stands [m]."""
    return view.lookat - PULLED_BACK * view.distance * view.axes[2]


def views_of(points: np.ndarray, yaw: float, fovy: float) -> Callable[[Preset], View]:
    """The view of points (n, 3) from each of the presets."""
    return lambda name: frame_view(points, ASPECT, yaw=yaw, fovy=fovy, camera=name)

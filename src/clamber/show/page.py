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
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, cast

import numpy as np

from clamber.errors import ClamberError, InputError
from clamber.show.framing import PRESETS, Preset, View, frame_view
from clamber.show.track import Track

FRAMES_A_SECOND = 30
PANEL_SECONDS = 0.2  # [s] between two states of the panel while it plays
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x", "8x")
SLIDER_STEP = 0.01  # [s]
STEP = 0.02  # [s] events nearer than this are where one is
PANEL_WIDTH, ASPECT = 360, 1.2  # [px]; of the picture beside it
SHEET = 576  # [px] screens narrower than this have the panel as a sheet
PULLED_BACK = 1.15  # cameras stand so much farther than they must
UPRIGHT, ABOVE_SHEET = 0.65, 0.4  # a phone's width to height; share above its panel
PLAY, PAUSE, BACK, ON = "play", "pause", "< contact", "contact >"
SECTIONS, CELLS = (150, 157, 166), (176, 183, 192)  # of the ground, light and dark


class Clock:
    """Playback time: play, scrub and step; callbacks are told of each change."""

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
        """Sets the range of the time line [s], and the events to step through."""
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

    def __init__(self, host: str, port: int) -> None:
        """Start serving; nothing is shown yet.

        Args:
            host: To listen on.
            port: From which on viser takes a free one.

        Raises:
            InputError: There is no such address.
        """
        import viser

        self.host, self.wanted = host, port
        self.missing: list[str] = []
        check_address(host, port)
        with _silent():
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.port = self.server.get_port()
        self.clock = Clock(self._tell)
        self._watchers: list[Callable[[float], str]] = []
        self._slow_watchers: list[Callable[[float], None]] = []
        self._seen: tuple[np.ndarray, float, float] | None = None
        self._usual: Preset = "corner"
        self._where: Callable[[float], np.ndarray] | None = None
        self._was = np.zeros(3)
        self._panel_next = 0.0
        self._stopped = threading.Event()
        self.server.on_client_connect(self._welcome)
        self._player = threading.Thread(target=self._play, daemon=True)
        self._player.start()

    def begin(
        self, title: str, missing: Sequence[str] = (), notes: Sequence[str] = ()
    ) -> None:
        """Have a new page, with ground and lights, in place of what was there.

        Args:
            title: Of the panel.
            missing: A sentence for each thing that cannot be shown.
            notes: What else there is to say.
        """
        gui = self.server.gui
        with self.clock.lock:
            self.clock.playing, self.clock.t = False, 0.0
            self._watchers, self._slow_watchers, self._where = [], [], None
            gui.reset()
            self.server.scene.reset()
        self.missing = list(missing)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        if missing or any(notes):
            gui.add_html(paragraphs((*missing, *(n for n in notes if n))))
        self._surroundings()

    def timeline(self) -> None:
        """Add what plays, and a folder of what is shown: `layers`."""
        gui = self.server.gui
        self._now = gui.add_html("")
        self._controls()
        with gui.add_folder("Show", expand_by_default=False) as self.layers:
            self._cameras()
        self._keys()

    @property
    def url(self) -> str:
        """Address of the page on this machine."""
        name = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{self.port}"

    def __repr__(self) -> str:
        """Its address."""
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

    def watch_slowly(self, show: Callable[[float], None]) -> None:
        """Have it told of times [s] as often as the panel is."""
        self._slow_watchers.append(show)

    def look(
        self, points: np.ndarray, yaw: float, fovy: float, camera: Preset = "corner"
    ) -> None:
        """Have cameras take in points (n, 3) [m]: of a new browser, and the presets.

        Args:
            points: To be in the picture.
            yaw: Heading of the robot [rad].
            fovy: Field of view [deg].
            camera: Preset from which a new browser looks.
        """
        self._seen, self._usual = (points, yaw, fovy), camera
        first = frame_view(points, ASPECT, yaw=yaw, fovy=fovy, camera=camera)
        initial = self.server.initial_camera
        initial.position, initial.look_at = eye_of(first), first.lookat
        initial.up, initial.fov = (0.0, 0.0, 1.0), math.radians(fovy)

    def aim(self, client: Any, name: Preset | None = None) -> None:
        """Have a browser look from a preset; a phone above the sheet of its panel.

        Args:
            client: The browser.
            name: None: the preset from which a new browser looks.
        """
        if self._seen is None:
            return
        points, yaw, fovy = self._seen
        half, aspect = math.tan(math.radians(fovy) / 2), client.camera.aspect
        share = ABOVE_SHEET if aspect < UPRIGHT else 1.0
        view = frame_view(
            points,
            aspect / share,
            yaw=yaw,
            fovy=2 * math.degrees(math.atan(share * half)),
            camera=name or self._usual,
        )
        reach = float(np.linalg.norm(eye_of(view) - view.lookat))
        down = (1 - share) * half * reach * view.axes[1]
        with client.atomic():
            client.camera.position = eye_of(view) - down
            client.camera.look_at = view.lookat - down

    def follow(self, where: Callable[[float], np.ndarray]) -> None:
        """Tell where the robot is, (3,) at a time [s], for cameras that go with it."""
        self._where = where

    def span(self, begin: float, end: float, events: Sequence[float]) -> None:
        """Sets the range of the time line [s], and the events to step through."""
        self._slider.min, self._slider.max = begin, max(end, begin + SLIDER_STEP)
        self.clock.span(begin, end, events)

    def _controls(self) -> None:
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

    def _keys(self) -> None:
        """Keys, which the browser's list of commands has too, and a table of them."""
        clock, gui = self.clock, self.server.gui

        def follow(_: Any) -> None:
            self._follow.value = not self._follow.value

        keys: list[tuple[str, str, Callable[[Any], None]]] = [
            ("Space", "Play or pause", lambda _: clock.toggle()),
            ("PageDown", "Next contact", lambda _: clock.step(1)),
            ("PageUp", "Previous contact", lambda _: clock.step(-1)),
            ("Home", "To the beginning", lambda _: clock.go(clock.begin)),
            ("End", "To the end", lambda _: clock.go(clock.end)),
            ("F", "Follow the robot, or not", follow),
        ]
        for i, name in enumerate(PRESETS, 1):
            act = partial(lambda event, name: self.aim(event.client, name), name=name)
            keys.append((str(i), f"Camera: {name}", act))
        for key, label, act in keys:
            hotkey = cast(Any, key if len(key) == 1 else key.lower())
            gui.add_command(label, hotkey=hotkey).on_trigger(act)
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_html(rows_of((key, label) for key, label, _ in keys))

    def _surroundings(self) -> None:
        """Lights and ground."""
        scene = self.server.scene
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_hemisphere(
            "/lights/sky",
            sky_color=(255, 255, 255),
            ground_color=(170, 165, 160),
            intensity=2.2,
        )
        self._sun = scene.add_light_directional(
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

    def _cameras(self) -> None:
        """From where, with the robot or not, and shadows."""
        gui = self.server.gui
        cameras = gui.add_button_group("camera", tuple(PRESETS))
        self._follow = gui.add_checkbox("follow the robot", False)
        shadows = gui.add_checkbox("shadows", False)

        @cameras.on_click
        def _(event: Any) -> None:
            if event.client is not None:
                self.aim(event.client, cast(Preset, cameras.value))

        @shadows.on_update
        def _(_: Any) -> None:
            self._sun.cast_shadow = shadows.value

    def _welcome(self, client: Any) -> None:
        """A phone's camera is not that of a screen, nor that of a phone on its side.

        A browser tells its size before it has laid out the page, and may set the usual
        camera after ours. One that a person has moved is left alone.
        """
        first = self.server.initial_camera
        where, aspect = np.full(3, np.nan), 0.0  # where we put it, and for which screen

        def fit(camera: Any) -> None:
            nonlocal where, aspect
            usual, ours = (
                np.allclose(camera.position, p, atol=1e-3)
                for p in (first.position, where)
            )
            upright = camera.aspect < UPRIGHT
            if (upright and usual) or (ours and camera.aspect != aspect):
                self.aim(client)
                where, aspect = client.camera.position, camera.aspect

        client.camera.on_update(fit)
        fit(client.camera)

    def _carry(self, t: float) -> None:
        """Move the cameras along with the robot."""
        if self._where is None:
            return
        at = self._where(t)
        way, self._was = at - self._was, at
        if self._follow.value and np.any(way):
            for client in self.server.get_clients().values():
                client.camera.position = client.camera.position + way

    def _tell(self, t: float) -> None:
        """The scene follows each step of the clock, the panel some while it plays."""
        now = time.perf_counter()
        with self.server.atomic():
            said = [show(t) for show in self._watchers]
            self._carry(t)
            self._buttons.options = (BACK, PAUSE if self.clock.playing else PLAY, ON)
            if not self.clock.playing or now >= self._panel_next:
                self._panel_next = now + PANEL_SECONDS
                self._slider.value = round(t, 2)
                self._now.content = "".join(said)
                for show in self._slow_watchers:
                    show(t)

    def _play(self) -> None:
        """Let time pass, in steps of a frame, while somebody looks."""
        last = time.perf_counter()
        while not self._stopped.wait(1.0 / FRAMES_A_SECOND):
            now = time.perf_counter()
            if self.server.get_clients():
                self.clock.advance(min(now - last, 0.25))
            last = now


class Work:
    """A job at a time, with its progress bar and its result."""

    def __init__(self, gui: Any, changed: Callable[[], None] = lambda: None) -> None:
        """Add a bar and a line to the panel.

        Args:
            gui: Of the page.
            changed: Called when it begins and when it has ended.
        """
        self._busy, self._changed = threading.Lock(), changed
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._said = gui.add_html("")

    @property
    def busy(self) -> bool:
        """Whether something is being done."""
        return self._busy.locked()

    def do(self, job: Callable[[], str], *stages: str) -> str:
        """Do it, unless something is being done; what goes wrong is said, not thrown.

        Args:
            job: Returns what is to be said in the end.
            stages: Of it, in order, which it reports; none of what is done at once.
        """
        if not self._busy.acquire(blocking=False):
            return ""
        self._changed()
        self._track = Track(*stages)
        try:
            if stages:
                self.report(stages[0], 0.0, "")
            said = job()
        except (ClamberError, OSError) as e:
            said = str(e)
        self._busy.release()
        self._bar.visible = False
        self.say(said)
        self._changed()
        return said

    def report(self, stage: str, share: float, note: str) -> None:
        """Shows progress: a stage, its share, and a note."""
        self._track.update(stage, share)
        self._bar.visible = True
        self._bar.value = 100.0 * self._track.share
        left = f" ({self._track})" if str(self._track) else ""
        self.say((f"{stage}: {note}" if note else stage) + left)

    def say(self, *texts: str) -> None:
        """Have these lines there, in place of those before."""
        self._said.content = paragraphs([x for x in texts if x])


def check_address(host: str, port: int) -> None:
    """Check that this machine can listen there: viser would retry without end.

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


def rows_of(rows: Iterable[Sequence[str]]) -> str:
    """A table as HTML, only its first column broken; the texts are no markup.

    On a phone, whose panel is narrow, the others are broken too, not cut off.
    """
    look = "padding: 1px 8px 1px 0; vertical-align: top"
    first, other = f'<td style="{look}">', f'<td class="whole" style="{look}">'
    rule = f"@media (min-width: {SHEET}px) {{ .whole {{ white-space: nowrap }} }}"
    lines = []
    for head, *others in rows:
        cells = [first + html.escape(head), *(other + html.escape(x) for x in others)]
        lines.append(f"<tr>{'</td>'.join(cells)}</td></tr>")
    rows = "".join(lines)
    table = f'<table style="font-size: 13px; margin: 4px 8px">{rows}</table>'
    return f"<style>{rule}</style>{table}"


def eye_of(view: View) -> np.ndarray:
    """(3,) where a camera stands [m]."""
    return view.lookat - PULLED_BACK * view.distance * view.axes[2]

"""The start page: choose a recording, a robot and a scene, and climb.

What is chosen is a `Climb`, the flags of `clamber climb`; the work is `run_climb`'s.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from clamber.errors import ClamberError, InputError
from clamber.model.kinematics import Kinematics
from clamber.model.robot import PROPOSED, ROBOTS, load_robot
from clamber.model.scene import NEAR_FACE, Box, Scene
from clamber.model.terrain import load_scene
from clamber.model.wheels import MODELS, model_of
from clamber.model.world import build_world
from clamber.recording.built_in import BUILT_IN
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.folder import new_run_folder, next_free_folder
from clamber.show.framing import robot_corners
from clamber.show.meshes import body_meshes, body_poses, pads_of
from clamber.show.page import Page, Work, paragraphs
from clamber.show.scene3d import DEVIATION, PERSON_BOX, TRIANGLES, Bodies
from clamber.show.track import EXECUTION, PLANNING
from clamber.study.climb import Climb, ClimbResult, command_of, run_climb

UPLOADS = Path("runs") / "uploads"
ONE_BOX = "one box"
HEIGHT, LOWEST, HIGHEST = 0.275, 0.05, 0.6  # [m] of the box
NEAREST, FARTHEST = NEAR_FACE, 0.6  # [m] of its face, from the ankles
GIZMO = 0.25  # [m]
# Files that are dropped go to the choice of a file that follows; the browser does the
# rest, as if they had been chosen there.
DROP = """<div style="margin: 4px 12px; padding: 8px; font-size: 12px; opacity: 0.8;
 text-align: center; border: 1px dashed currentColor; border-radius: 6px"
 ondragover="event.preventDefault()" ondrop="event.preventDefault();
 const input = [...document.querySelectorAll('input[type=file]')]
  .find((x) => this.compareDocumentPosition(x) & 4);
 input.files = event.dataTransfer.files;
 input.dispatchEvent(new Event('change', {bubbles: true}))">drop %s here</div>"""


class Choice:
    """A list to choose from, and a file drop for another one."""

    def __init__(
        self,
        page: Page,
        name: str,
        known: Mapping[str, str],
        brought: Callable[[Path], str],
        changed: Callable[[], None],
    ) -> None:
        """Add it to the panel.

        Args:
            page: With the panel.
            name: Of what is chosen.
            known: Names for people, and what `clamber climb` calls them.
            brought: Checks a file that was brought; what `climb` calls it.
            changed: Called when another one is chosen.
        """
        self._known, self._brought = dict(known), brought
        gui = page.server.gui
        self._choice = gui.add_dropdown(name, tuple(self._known))
        gui.add_html(DROP % html.escape(f"a {name}"))
        upload = gui.add_upload_button(f"or choose a {name} file")
        self._said = gui.add_html("")
        self._choice.on_update(lambda _: changed())
        upload.on_upload(lambda _: self._bring(upload.value.name, upload.value.content))

    @property
    def value(self) -> str:
        """As `clamber climb` calls it."""
        return self._known[str(self._choice.value)]

    def say(self, text: str) -> None:
        """Shows a line of text below the choice."""
        self._said.content = paragraphs([text])

    def _bring(self, name: str, content: bytes) -> None:
        """Keep a file, and choose it where it can be used."""
        try:
            UPLOADS.mkdir(parents=True, exist_ok=True)
            file = next_free_folder(UPLOADS, Path(name).stem) / Path(name).name
            file.write_bytes(content)
            name = f"{file.parent.name}{file.suffix}"  # of two alike, another one
            self._known[name] = self._brought(file)
        except (ClamberError, OSError) as e:
            self.say(str(e))
            return
        self.say("")
        self._choice.options = tuple(self._known)
        self._choice.value = name


class StartPage:
    """Choices, what they look like, and the climb."""

    def __init__(self, page: Page, opened: Callable[[Path], None]) -> None:
        """Fill the page.

        Args:
            page: To begin on.
            opened: Shows a run folder in its place.
        """
        self._page, self._opened, self._count = page, opened, 0
        page.begin("New climb")
        gui, scene = page.server.gui, page.server.scene
        text = "A demonstration, a robot, and an obstacle to climb."
        gui.add_html(paragraphs([text]))
        demos = {f"{name} (synthetic)": name for name in BUILT_IN}
        self._demo = Choice(page, "recording", demos, _recording, lambda: None)
        self._robot = Choice(page, "robot", known_robots(), _robot, self._draw)
        self._scene = Choice(page, "scene", {ONE_BOX: ""}, _scene, self._draw)
        with gui.add_folder("Box"):
            self._height = gui.add_slider("height [m]", LOWEST, HIGHEST, 0.005, HEIGHT)
            self._distance = gui.add_slider(
                "distance [m]", NEAREST, FARTHEST, 0.005, NEAREST
            )
        self._button = gui.add_button("Climb", color="green")
        self._work = Work(gui, self._enable)
        self._box = scene.add_box("/start/box", color=PERSON_BOX)
        self._gizmo = scene.add_transform_controls(
            "/start/gizmo",
            scale=GIZMO,
            active_axes=(True, False, True),
            disable_rotations=True,
            disable_sliders=True,
            depth_test=False,
        )
        for slider in (self._height, self._distance):
            slider.on_update(lambda _: self._place())
        self._gizmo.on_update(self._dragged)
        self._button.on_click(lambda _: self._climb())
        self._preview = scene.add_frame("/start/0", show_axes=False)
        self._draw()

    # What is chosen.

    def climb(self, folder: Path) -> Climb:
        """What is chosen; a box that stands elsewhere is written to the run folder.

        Raises:
            OSError: It cannot be written.
        """
        height: float | None = None
        scene = self._scene.value
        if not scene and self._distance.value <= NEAREST:
            height = round(float(self._height.value), 4)
        elif not scene:
            box = self._one_box()
            record: dict[str, Any] = {
                "name": box.name,
                "size": box.size.round(4).tolist(),
                "position": box.centre[:2].round(4).tolist(),
            }
            scene = str(folder / "box.yaml")
            Path(scene).write_text(yaml.safe_dump({"boxes": [record]}))
        return Climb(
            demo=self._demo.value,
            robot=self._robot.value,
            height=height,
            scene=scene or None,
        )

    def _one_box(self) -> Box:
        """As the sliders say."""
        (box,) = Scene.from_height(round(float(self._height.value), 4)).boxes
        away = float(self._distance.value) - NEAREST
        return replace(box, centre=box.centre + np.array([away, 0.0, 0.0]))

    # What it looks like.

    def _place(self) -> None:
        """The box and its gizmo, as the sliders say."""
        box = self._one_box()
        self._box.dimensions = tuple(box.size.tolist())
        self._box.position = box.centre
        edge = np.array([-box.size[0] / 2, 0.0, box.size[2] / 2])
        self._gizmo.position = box.centre + edge

    def _dragged(self, _: Any) -> None:
        """The gizmo, on the near edge of the box, sets the sliders."""
        x, _, z = np.array(self._gizmo.position).tolist()
        self._distance.value = min(max(x, NEAREST), FARTHEST)
        self._height.value = min(max(z, LOWEST), HIGHEST)

    def _draw(self) -> None:
        """Robot and scene, in place of those before."""
        one = not self._scene.value
        for part in (self._height, self._distance, self._box, self._gizmo):
            part.visible = one
        try:
            scene = Scene.from_height(LOWEST) if one else load_scene(self._scene.value)
            make_of_wheel(self._robot.value)
            world = build_world(self._robot.value, scene)
        except (ClamberError, OSError) as e:
            self._work.say(str(e))
            return
        kin = Kinematics(world)
        kin.update(world.home)
        meshes = body_meshes(
            world.model,
            max_triangles=TRIANGLES,
            deviation=DEVIATION,
            pads=pads_of(world),
        )
        self._preview.remove()
        self._count += 1
        add, name = self._page.server.scene, f"/start/{self._count}"
        self._preview = add.add_frame(name, show_axes=False)
        robot = [m for m in meshes if m.body != 0]
        Bodies(add, f"{name}/robot", robot).pose(body_poses(kin.data, robot))
        tops = [s.vertices for s in scene.supports[1:]]
        if one:
            self._place()
            tops = [self._one_box().top.vertices]
        else:
            Bodies(add, f"{name}/scene", [m for m in meshes if m.body == 0])
        points = np.concatenate([robot_corners(kin), *tops])
        self._page.look(points, float(scene.start[2]), 45.0)
        for client in self._page.server.get_clients().values():
            self._page.aim(client)

    # The climb.

    def _enable(self) -> None:
        self._button.disabled = self._work.busy

    def _climb(self) -> None:
        """Climb, and open the run."""
        made: list[Path] = []

        def job() -> str:
            folder = new_run_folder(None, "climb")
            climb = self.climb(folder)
            result = run_climb(climb, folder=folder, progress=self._work.report)
            made.append(folder)
            return outcome(climb, result)

        said = self._work.do(job, "detect", *PLANNING, *EXECUTION)
        if made:
            try:
                self._opened(made[0])
            except InputError:  # there is nothing to open: it was not even planned
                return
            gui = self._page.server.gui
            gui.add_html(paragraphs([said]))
            again = gui.add_button("New climb")
            again.on_click(lambda _: self._start_again())

    def _start_again(self) -> None:
        StartPage(self._page, self._opened)


def outcome(climb: Climb, result: ClimbResult) -> str:
    """The result of a climb, and the command that repeats it."""
    ended = "Success: the robot reached the goal stance."
    if not result.reached:
        ended = f"Failed: {result.why}."
    return f"{ended} The same from a terminal: {command_of(climb)}"


# Robots by name.


def known_robots() -> dict[str, str]:
    """Built-in ones, those below `robots/`, and those of installed wheels."""
    built_in = sorted(p.parent.name for p in ROBOTS.glob("*/robot.yaml"))
    own = sorted(PROPOSED.glob("*/robot.yaml"))
    made = {p.parent.name for p in own}
    carried = [n for n in MODELS if n not in made and model_of(n) is not None]
    return (
        {name: name for name in built_in}
        | {str(p.parent): str(p) for p in own}
        | {f"{name} (from a package)": name for name in carried}
    )


def make_of_wheel(robot: str) -> None:
    """Propose a wheel's robot, as and where `clamber robot init` does, at first."""
    folder = PROPOSED / robot
    if robot in MODELS and not folder.exists():
        _propose(robot, folder)


def _propose(model: str | Path, folder: Path) -> None:
    """Write what is proposed of a model to a new folder."""
    # Slow to import, and rarely needed.
    from clamber.model.propose import propose_robot
    from clamber.run.proposal import save_proposal

    proposal = propose_robot(model)
    folder.mkdir(parents=True)
    save_proposal(proposal, folder)


# Files that are brought.


def _recording(file: Path) -> str:
    """A recording that can be read, and in which contacts are found."""
    detect_contacts(load_demo(file))
    return str(file)


def _robot(file: Path) -> str:
    """A robot.yaml, or one that is proposed of a model."""
    if file.suffix in (".yaml", ".yml"):
        load_robot(file)
        return str(file)
    proposed = file.parent / "robot"
    _propose(file, proposed)
    robot = proposed / "robot.yaml"
    load_robot(robot)
    return str(robot)


def _scene(file: Path) -> str:
    """A scene, or boxes as OBJ or MJCF."""
    load_scene(file)
    return str(file)

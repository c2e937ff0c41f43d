"""Commands that look at a run, a robot or a scene, hand them on, or do many runs."""

from __future__ import annotations

import math
import re
import socket
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import clamber
from clamber.cli.flags import (
    Place,
    Printed,
    RobotName,
    RunFolder,
    shown,
)
from clamber.cli.output import (
    INTERRUPTED,
    MISSED,
    REACHED,
    Switch,
    filling,
    new_table,
)
from clamber.errors import ClamberError, InputError
from clamber.model.progress import Progress
from clamber.show.track import DRAWING, Track


@dataclass(frozen=True, kw_only=True)
class RenderCommand:
    """Draw pictures and a video of a run, all of them or one."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    video: Switch = False
    """The video alone: MP4 with clamber[video], else an animated WebP."""
    sheet: Switch = False
    """The sheet of keyframes alone."""
    frame: Annotated[float | None, shown("T")] = None
    """One picture alone, at that time [s]."""
    camera: Literal["corner", "side", "front", "behind", "top"] = "corner"
    """From where the robot is seen, as it faces at its start."""
    marks: Annotated[
        Literal["none", "contacts", "forces"] | None,
        tyro.conf.arg(
            metavar="none|contacts|forces",
            help_behavior_hint="(default: contacts in a frame, none in a video)",
        ),
    ] = None
    """What is drawn over a frame or a video: contacts, or these with their forces."""
    transparent: Switch = False
    """Without ground or sky, on a transparent background; with --frame."""
    size: Annotated[str | None, shown("1080p|WxH", "frames 1080p, videos 720p")] = None
    """Size of the video, the frame, or each picture of the sheet."""
    out: Annotated[Path | None, shown("FILE", "in RUN")] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run to pictures."""
        self._check()
        alone = self.sheet or self.frame is not None
        track = Track(
            *(["pictures"] if alone else ["video"] if self.video else DRAWING)
        )
        with self.output.progress(track) as report, filling(self.run_folder):
            files = self._draw(report)
        names = [str(f) for f in files]
        self.output.show({"files": names}, note="\n".join(names))
        return REACHED

    def _check(self) -> None:
        """One of the three, and flags that go with it."""
        asked = [self.video, self.sheet, self.frame is not None]
        if sum(asked) > 1:
            raise InputError("--video, --sheet, --frame: give one of them alone")
        if self.transparent and self.frame is None:
            raise InputError("--transparent: give --frame too, or leave it out")
        if self.marks is not None and (self.sheet or self.transparent):
            raise InputError("--marks: not with --sheet or --transparent")
        special = self.marks or self.camera != "corner" or self.size or self.out
        if special and not any(asked):
            flags = "--marks, --camera, --size, --out"
            raise InputError(f"{flags}: give --video, --sheet or --frame too")

    def _draw(self, report: Progress) -> list[Path]:
        if not (self.video or self.sheet or self.frame is not None):
            return clamber.render_run(self.run_folder, report=report)
        from clamber.show import film, pictures

        size = None if self.size is None else _picture_size(self.size)
        given: dict[str, Any] = {"camera": self.camera}
        try:
            if self.frame is not None:
                given |= {"out": self.out, "transparent": self.transparent}
                given |= {} if size is None else {"size": size}
                given |= {} if self.marks is None else {"marks": self.marks}
                report("pictures", 0.0, "")
                return [pictures.render_frame(self.run_folder, self.frame, **given)]
            plan = clamber.load_plan(self.run_folder)
            if self.sheet:
                path = self.out or self.run_folder / "keyframes.png"
                if path.suffix != ".png":
                    raise InputError("a name that ends in .png", source=path)
                given |= {} if size is None else {"tile": size}
                given["report"] = report
                return [pictures.keyframe_sheet(plan, path, **given)]
            rollout = clamber.load_rollout(self.run_folder)
            given |= {"out": self.out, "size": size, "report": report}
            given |= {} if self.marks is None else {"marks": self.marks}
            given |= {"skeleton": film.skeleton_of_plan(plan)}
            return [film.video(plan, rollout, self.run_folder, **given)]
        except OSError as e:
            expected = f"a file that can be written ({e.strerror or e})"
            value = str(self.out or self.run_folder)
            raise InputError(expected, "--out", value=value) from e


def _picture_size(text: str) -> tuple[int, int]:
    """Width and height of `1080p` (16 to 9) or `1280x720`; even, as videos need."""
    lines = re.fullmatch(r"(\d{1,5})p", text)
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if lines:
        height = int(lines[1])
        size = (2 * round(height * 8 / 9), height)
    elif sides:
        size = (int(sides[1]), int(sides[2]))
    else:
        size = (0, 0)
    if not all(64 <= x <= 4096 and x % 2 == 0 for x in size):
        expected = "such as 1080p or 1280x720, even numbers from 64 to 4096"
        raise InputError(expected, "--size", value=text)
    return size


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Write a run as one HTML file: an animation to turn and scrub, plots, tables."""

    run_folder: RunFolder
    """A run folder, complete or not."""
    compare: Annotated[Path | None, shown("RUN2")] = None
    """Another run, shown beside it."""
    out: Annotated[Path | None, shown("FILE", "RUN/report.html")] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run to one page."""
        with self.output.progress(Track("report")) as report:
            files = {"compare": self.compare, "out": self.out}
            done = clamber.write_report(self.run_folder, **files, progress=report)
            report("report", 1.0, "")
        self.output.warn(*done.missing)
        record = {"file": str(done.file), "missing": list(done.missing)}
        self.output.show(record, note=str(done.file))
        return REACHED


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """A page in the browser: climb, look at runs, edit a plan."""

    sources: Annotated[
        tuple[str, ...], tyro.conf.Positional, shown("RUN|RECORDING", "a new climb")
    ] = ()
    """Run folders, shown beside each other; or a recording. Without: a start page."""
    demo: Annotated[str | None, shown("RECORDING|NAME", "the run's own")] = None
    """The recording that is shown beside a run."""
    scene: Annotated[Path | None, shown("FILE")] = None
    """The scene.yaml of a recording that has none."""
    host: Annotated[str | None, shown("ADDRESS", "this machine alone")] = None
    """Address to listen on; 0.0.0.0: every one of this machine."""
    port: Annotated[int | None, shown("N", "8080")] = None
    """Port, or the next one that is free."""
    output: Printed

    def run(self) -> int:
        """Serve until Ctrl-C."""
        from clamber.show.live import open_view

        place: dict[str, Any] = {"host": self.host, "port": self.port}
        source, *beside = self.sources or (None,)
        page = open_view(
            source,
            beside=beside,
            demo=self.demo,
            scene=None if self.scene is None else clamber.load_scene(self.scene),
            **{k: v for k, v in place.items() if v is not None},
        )
        try:
            self._say(page)
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            return REACHED
        finally:
            page.close()

    def _say(self, page: Any) -> None:
        """Prints the page's address, and what it cannot show."""
        self.output.warn(*page.missing)
        lines = [f"the page is at {page.url} (Ctrl-C ends it)"]
        if page.port != page.wanted:
            lines.insert(0, f"port {page.wanted} is in use: {page.port} instead")
        if page.host == "127.0.0.1":
            lines.append(
                f"from another machine: ssh -L {page.port}:127.0.0.1:{page.port}"
                f" {socket.gethostname()}, then the same address there"
            )
        elif page.host in ("0.0.0.0", "::"):
            lines.append(
                f"from another machine: http://{socket.gethostname()}:{page.port}; "
                "whoever reaches it can edit and save"
            )
        record = {"url": page.url, "port": page.port, "missing": page.missing}
        self.output.show(record, note="\n".join(lines))
        sys.stdout.flush()


@dataclass(frozen=True, kw_only=True)
class ExportCommand:
    """Write the motion of a run for other tools: CSV, MCAP (ROS 2), npz (trainers)."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    to: Literal["csv", "mcap", "npz"]
    """The format."""
    rate: Annotated[int | None, shown("HZ", "100; npz 50; at most 1000")] = None
    """Samples per second, a divisor of 1000."""
    lead_in: Annotated[str | None, shown("FILE|home")] = None
    """Measured joint angles [rad] by name (YAML or JSON), to start from."""
    lead_in_speed: Annotated[float, shown("RAD/S")] = field(
        default_factory=lambda: import_module("clamber.run.lead_in").SPEED
    )
    """Largest joint speed on the way from there to the first posture."""
    layout: Annotated[
        Literal["mjlab", "holosoma"] | None, shown("mjlab|holosoma", "mjlab; npz alone")
    ] = None
    """Whose joint_pos and joint_vel an npz holds."""
    out: Annotated[Path | None, shown("FILE", "RUN/motion.FORMAT")] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run folder to a file."""
        done = clamber.export_run(
            self.run_folder,
            to=self.to,
            out=self.out,
            rate=self.rate,
            lead_in=self.lead_in,
            lead_in_speed=self.lead_in_speed,
            layout=self.layout,
        )
        parts = [f"{done.samples} samples at {done.rate} Hz"]
        if done.lead_in:
            parts.append(f"the first {done.lead_in:.2f} s lead in")
        forces = "with contact forces" if done.forces else "no forces: not simulated"
        parts.append(forces)
        note = f"{done.file}: {', '.join(parts)}"
        self.output.show({**asdict(done), "file": str(done.file)}, note=note)
        return REACHED


@dataclass(frozen=True, kw_only=True)
class SceneCommand:
    """Check a scene, say what is in it and, with --out, draw it."""

    file: Annotated[Path, tyro.conf.Positional, shown("FILE")]
    """A scene.yaml, boxes as OBJ, MJCF, URDF or SDF, a mesh, or a cloud of points."""
    robot: RobotName = "coman"
    """Who stands at its start: a robot by name, or a robot.yaml."""
    out: Annotated[Path | None, shown("DIR")] = None
    """Where to write the picture scene.png."""
    output: Printed

    def run(self) -> int:
        """Scene file to a table of its supports."""
        scene = clamber.load_scene(self.file)
        table = new_table("support", "centre [m]", "slope [deg]", "friction", "")
        supports = []
        faults = clamber.check_scene(scene)
        for s in scene.supports:
            centre = [round(float(x), 6) for x in s.position]
            slope = math.degrees(math.acos(min(1.0, float(s.normal[2]))))
            fault = faults.get(s.name, "")
            row = {"name": s.name, "centre": centre, "slope": round(slope, 4)}
            supports.append({**row, "friction": s.friction, "fault": fault})
            text = " ".join(f"{x:.3f}" for x in centre)
            table.add_row(s.name, text, f"{slope:.1f}", f"{s.friction:g}", fault)
        record: dict[str, Any] = {"supports": supports, "picture": None}
        refused = [r.why for m in scene.meshes for r in m.rejected]
        record |= {"rejected": refused, "notes": list(scene.notes)}
        why = Counter(text.partition(":")[0] for text in refused)
        if why:
            parts = ", ".join(f"{text} {n}" for text, n in sorted(why.items()))
            self.output.warn(f"flat parts that are no supports: {parts}")
        self.output.warn(*scene.notes)
        note = ""
        if self.out is not None:
            robot = clamber.load_robot(self.robot)
            folder = clamber.new_run_folder(self.out, "scene")
            record["picture"] = note = str(
                clamber.draw_scene(robot, scene, folder / "scene.png")
            )
        self.output.show(record, table, note=note)
        return MISSED if faults else REACHED


@dataclass(frozen=True, kw_only=True)
class RobotCommand:
    """Bring a robot: init proposes a robot.yaml, check says what is wrong with one."""

    action: tyro.conf.Positional[Literal["init", "check"]]
    """init: from an MJCF or URDF. check: a robot.yaml."""
    model: Annotated[str, tyro.conf.Positional, shown("MODEL")]
    """init: an MJCF or URDF; or g1, icub, romeo, talos, where a wheel has them.
    check: a robot.yaml, or a robot by name."""
    effort: Annotated[Path | None, shown("FILE")] = None
    """init: effort limits the model lacks: YAML {joint: N m}, or another model."""
    out: Annotated[Path | None, shown("DIR", "init: robots/NAME")] = None
    """Where to write robot.yaml and robot.xml (init), and the picture robot.png."""
    output: Printed

    def run(self) -> int:
        """Description to a proposal, or a robot file to what a planner sees of it."""
        with self.output.progress(Track("robot")) as report:
            robot, found, out, notes = self._look(report)
        table = new_table("limb", "from", "over", "to", "surfaces", "length [m]")
        for limb in robot.limbs.values():
            chain = (limb.name, limb.root, limb.middle, limb.end)
            length = f"{found.lengths[limb.name]:.3f}"
            table.add_row(*chain, ", ".join(limb.surfaces), length)
        record = {
            "out": None if out is None else str(out),
            "name": robot.name,
            "mass": round(found.mass, 4),
            "joints": found.joints,
            "surfaces": list(robot.surfaces),
            "segments": found.segments,
            "knee_height": found.knee_height,
            "com_height": found.com_height,
            "faults": list(found.faults),
            "notes": notes,
        }
        lengths = ", ".join(f"{k} {v:.3f} m" for k, v in found.segments.items())
        lines = [
            *(f"note: {x}" for x in notes),
            *(f"wrong: {x}" for x in found.faults),
            f"{robot.name}: {found.mass:.2f} kg, {found.joints} actuated joints, CoM"
            f" {found.com_height:.3f} m and knees {found.knee_height:.3f} m high as it"
            f" stands; {lengths}",
        ]
        if out is not None:
            lines.append(f"the files are in {out}: look at robot.png")
        self.output.show(record, table, note="\n".join(lines))
        return MISSED if found.faults else REACHED

    def _look(
        self, report: Progress
    ) -> tuple[clamber.Robot, clamber.Checkup, Path | None, list[str]]:
        """The robot, what is found of it, where its files are, and what was noted."""
        from clamber.model.robot import PROPOSED

        notes: list[str] = []
        path, out = self.model, self.out
        if self.action == "init":
            proposal = clamber.propose_robot(
                self.model, effort_from=self.effort, progress=report
            )
            out = out or PROPOSED / proposal.name
            if out.exists() and (not out.is_dir() or any(out.iterdir())):
                raise InputError("a new or empty folder", "--out", value=str(out))
            out = clamber.new_run_folder(out, "robot")
            clamber.save_proposal(proposal, out)
            path, notes = str(out / "robot.yaml"), list(proposal.notes)
        report("robot", 0.7, "checking it")
        robot = clamber.load_robot(path)
        found = clamber.check_robot(robot)
        if out is not None:
            report("robot", 0.8, "drawing it")
            try:
                out.mkdir(parents=True, exist_ok=True)
                clamber.draw_robot(robot, out / "robot.png")
            except ClamberError as e:  # the robot is checked all the same
                notes.append(str(e))
        return robot, found, out, notes


@dataclass(frozen=True, kw_only=True)
class SweepCommand:
    """Many climbs, by a spec: one row a run, success against each factor."""

    spec: Annotated[Path, tyro.conf.Positional, shown("SPEC")]
    """A spec.yaml: what all runs share, and a grid, a random sample or a search."""
    workers: Annotated[int | None, shown("N", "one a core")] = None
    """Processes that do the runs."""
    scheduler: Annotated[str | None, shown("ADDRESS")] = None
    """A dask scheduler, whose workers do the runs instead."""
    out: Place = None
    """The sweep's folder (runs/<name of the spec>); a sweep in it goes on."""
    output: Printed

    def run(self) -> int:
        """Spec to table and curves."""
        from clamber.study.spec import load_spec

        if self.workers is not None and self.workers < 1:
            raise InputError("1 or more", source="--workers", value=self.workers)
        if self.workers is not None and self.scheduler is not None:
            raise InputError("--workers, --scheduler: give one of them alone")
        spec = load_spec(self.spec)
        folder = self.out or Path("runs") / self.spec.stem
        from clamber.study import sweep

        sweep.check_inputs(spec)
        try:
            with self.output.progress(Track("sweep", "draw")) as report:
                rows, pace = sweep.run_sweep(
                    spec,
                    folder,
                    workers=self.workers,
                    scheduler=self.scheduler,
                    progress=report,
                )
                report("draw", 0.0, "")
                from clamber.study import curves  # Matplotlib is slow to import

                curves.save_curves(spec, rows, folder)
                report("draw", 1.0, "")
        except KeyboardInterrupt:
            sys.stderr.write(
                f"clamber: interrupted; the finished rows are in {folder}, and the same"
                " command goes on from there\n"
            )
            return INTERRUPTED
        summaries = curves.summarise(spec, rows)
        table = new_table(
            "controller", "to", "runs", "reached", "95 % interval", "half at",
            "95 % interval",
        )  # fmt: skip
        for s in summaries:
            table.add_row(
                s.controller,
                "" if s.end is None else f"{s.factor} {s.end:g}",
                str(s.runs),
                f"{s.reached} ({100 * s.share:.1f} %)",
                f"{100 * s.low:.1f} to {100 * s.high:.1f} %",
                s.half if isinstance(s.half, str) else f"{s.half:.4g}",
                ""
                if s.half_from is s.half_to is None
                else " to ".join(
                    "-" if x is None else f"{x:.4g}" for x in (s.half_from, s.half_to)
                ),
            )
        note = f"{len(rows)} rows, {pace.runs} of them new; the files are in {folder}"
        errors = sum(s.errors for s in summaries)
        if errors:
            note = f"{errors} runs crashed and count as not reached; {note}"
        record = {
            "out": str(folder),
            "rows": len(rows),
            "new": pace.runs,
            "summary": [asdict(s) for s in summaries],
        }
        self.output.show(record, table, note=note)
        return REACHED

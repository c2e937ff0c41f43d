"""Jobs are the flags of `clamber climb`, and end as it does."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from clamber import cli
from clamber.cli import commands, parse
from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.execution.verdict import Figure
from clamber.planning.records import Budget
from clamber.study.climb import FLAGS, Climb, climb_of, command_of, run_climb


def parsed(command: str) -> commands.ClimbCommand:
    words = shlex.split(command)
    assert words[0] == "clamber"
    return parse(words[1:])


@pytest.mark.parametrize(
    "job",
    [
        Climb(height=0.275),
        Climb(
            height=0.3, robot="coman29", controller="pid", speed=0.05, method="lbfgs"
        ),
        Climb(height=0.3, budget=2.5, search=Budget(tries=7)),
        Climb(height=0.3, speed="max", demo="a file.yaml", robot="my robots/it's.yaml"),
        Climb(scene="boxes.yaml", disturb=Disturbance(height=-5e-05, x=-0.1, seed=17)),
        Climb(
            height=0.1,
            disturb=Disturbance(
                friction=0.31,
                unevenness=0.03,
                roll=0.1,
                pitch=-0.123456,
                y=1e-7,
                yaw=0.2,
                mass=1.1,
                effort=0.7,
                delay=0.01,
                noise=0.0,
                push=90.0,
            ),
        ),
    ],
)
def test_the_command_of_a_job_is_that_job(job: Climb):
    climb = parsed(command_of(job))
    assert climb.demo == job.demo
    assert climb.world.robot == job.robot
    assert climb.world.height == job.height
    assert climb.world.scene == (None if job.scene is None else Path(job.scene))
    assert climb.planning.method == job.method
    assert climb.planning.speed == job.speed
    assert climb.execution.controller == job.controller
    assert climb.execution.disturb == job.disturb
    assert climb.contacts == job.contacts
    bounds = climb.search.read(climb.planning)["budget"]
    assert bounds == replace(job.search, seconds=job.budget)


def test_a_command_names_what_differs_and_no_more():
    job = Climb(height=0.275, disturb=Disturbance(friction=0.31, seed=17))
    assert command_of(job) == (
        "clamber climb --robot coman --height 0.275 --controller mixed"
        " --disturb.friction 0.31 --disturb.seed 17"
    )


def test_flags_have_the_defaults_of_the_command():
    climb = parsed("clamber climb --height 0.275")
    job = climb_of({"height": 0.275})
    assert job == Climb(height=0.275)
    assert (climb.demo, climb.world.robot) == (job.demo, job.robot)
    assert (climb.planning.method, climb.planning.speed) == (job.method, job.speed)
    assert climb.execution.controller == job.controller
    assert climb.execution.disturb == job.disturb
    assert climb.contacts == job.contacts
    bounds = climb.search.read(climb.planning)["budget"]
    assert bounds == replace(job.search, seconds=job.budget)


def test_flags_are_checked_one_by_one():
    assert climb_of({"height": 0.3, "disturb.mass": 1.1}).disturb.mass == 1.1
    for flags, said in (
        ({"hight": 0.3}, "flag is 'hight'; expected one of demo, robot, height"),
        ({"height": "x"}, "height is 'x'"),
        ({"height": 0.3, "disturb.mass": 100.0}, "disturb.mass is 100.0"),
        ({"height": 0.3, "controller": "lqr"}, "controller is 'lqr'"),
        ({"height": 0.3, "scene": "s.yaml"}, "height or scene, one of them"),
        ({}, "height or scene, one of them"),
        ({"height": 0.3, "search.tries": -1}, "search.tries is -1"),
        ({"height": 0.3, "contacts": "none"}, "contacts is 'none'"),
        ({"height": 0.3, "budget": -1.0}, "budget is -1.0"),
        ({"height": 0.3, "search.seconds": 1.0}, "flag is 'search.seconds'"),
    ):
        with pytest.raises(InputError) as wrong:
            climb_of(flags)
        assert said in str(wrong.value)
    assert "disturb.friction" in FLAGS
    assert "search.depth" in FLAGS
    assert not {"disturb", "search"} & set(FLAGS)


def test_jobs_are_equal_by_value():
    a = Climb(height=0.3, disturb=Disturbance(mass=1.1))
    assert a == replace(a)
    assert hash(a) == hash(replace(a))
    assert a != replace(a, disturb=Disturbance())


def test_a_box_out_of_reach_is_an_outcome():
    outcome = run_climb(Climb(height=3.0))
    assert not outcome.reached
    assert outcome.why.startswith("no plan: ")
    assert "within" in outcome.why
    assert outcome.seconds == 0.0


def test_a_fall_ends_the_run_and_is_the_reason():
    job = Climb(
        height=0.275,
        controller="pid",
        speed=1.0,
        disturb=Disturbance(effort=0.05),
    )
    outcome = run_climb(job)
    assert (outcome.reached, outcome.why) == (False, "fell")
    assert 0.0 < outcome.seconds < 5.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "job",
    [
        Climb(height=0.275, controller="pid", speed=1.0, disturb=Disturbance(x=0.01)),
        Climb(
            height=0.275,
            controller="pid",
            speed=1.0,
            disturb=Disturbance(friction=0.05, seed=7),
        ),
        Climb(
            height=0.275,
            controller="mixed",
            disturb=Disturbance(friction=0.6, unevenness=0.02, push=20.0, seed=17),
        ),
    ],
)
def test_the_command_of_a_row_gives_its_verdict(
    job: Climb, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    outcome = run_climb(job)
    words = shlex.split(command_of(job))[1:]
    code = cli.main([*words, "--json", "--out", str(tmp_path)])
    record = json.loads(capsys.readouterr().out)
    assert code == (0 if outcome.reached else 1)
    assert record["reached"] == outcome.reached
    largest = record["criteria"][Figure.EFFORT]["value"]
    assert outcome.effort == pytest.approx(largest, abs=1e-6)
    again = sum(e["type"] == "Replanned" for e in record["events"])
    assert outcome.replans == again
    if not outcome.reached and outcome.why in record["criteria"]:
        assert not record["criteria"][outcome.why]["ok"]

"""Figures show what is in recordings, runs and policies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import clamber
from clamber.contact.contact import PARTS, ContactInterval, ContactSequence, Stance
from clamber.contact.learn import learn_policy
from clamber.contact.policy import GeneralPolicy
from clamber.model.scene import Box, Scene
from clamber.show import plots
from clamber.show.plots import pelvis_plot, policy_plot, save_pictures
from conftest import contact
from test_learn import crossing, posed


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that are saved."""
    saved: list[Figure] = []
    save = plots.save_plot

    def keep(figure, path):
        saved.append(figure)
        return save(figure, path)

    monkeypatch.setattr(plots, "save_plot", keep)
    return saved


def texts(figure: Figure) -> list[str]:
    return [t.get_text() for ax in figure.axes for t in ax.texts]


def test_options_and_states_are_all_there(tmp_path, figures):
    policy = learn_policy([crossing()])
    policy_plot(policy, tmp_path / "policy.png")
    shown = texts(figures[0])
    for option in policy.options:
        assert any(t.startswith(option.name) for t in shown)
        assert f"{option.repeats} times" in shown
    demo = policy.demos[0]
    assert {str(i) for i in range(len(demo.states))} <= set(shown)
    for name in {a for a in demo.actions if a is not None}:
        below = [t for t in figures[0].axes[1].texts if t.get_text() == name]
        assert len(below) == demo.actions.count(name)
    assert shown.count("breaks") == demo.actions.count(None)


def test_a_policy_without_its_demonstrations_can_be_drawn(tmp_path):
    policy = replace(learn_policy([crossing()]), demos=())
    for file in save_pictures(policy, tmp_path / "p.json"):
        with Image.open(file) as picture:
            assert picture.size[0] > 500
    assert {f.name for f in tmp_path.iterdir()} == {"p.png", "p-pelvis.png"}


def test_densities_have_area_one_and_what_is_imposed_is_shaded(tmp_path, figures):
    policy: GeneralPolicy = learn_policy([posed()])
    pelvis_plot(policy, tmp_path / "p.png")
    axes = figures[0].axes
    assert len(axes) == 6
    for column, d in enumerate((policy.near_edge, policy.over_top)):
        for k in range(3):
            ax = axes[2 * k + column]
            text = ax.texts[0].get_text()
            assert ("too wide" in text) == (d.imposed[k] is None)
            assert bool(ax.patches) == (d.imposed[k] is not None)
            curves = [x for x in ax.lines if x.get_marker() == "None"]
            assert len(curves) == (0 < d.sigma[k] < np.inf)
            for curve in curves:
                x, y = (np.asarray(v, dtype=float) for v in curve.get_data())
                assert np.trapezoid(y, x) == pytest.approx(1.0, abs=0.02)


def test_the_demonstration_is_drawn_with_what_was_found(tmp_path: Path):
    t = np.linspace(0.0, 4.0, 200)
    names = (*PARTS, "LShoulder", "RShoulder", "LHip", "RHip", "Pelvis")
    position = np.zeros((len(t), len(names), 3))
    position[:, :, 2] = 0.5 + 0.3 * np.sin(t)[:, None] + 0.02 * np.arange(len(names))
    box = Box(
        name="table",
        size=np.ones(3),
        centre=np.array([1, 0, 0.0]),
        rotation=np.eye(3),
    )
    scene = Scene(boxes=(box,), start=np.zeros(3))
    demo = clamber.Demonstration(
        source="made up",
        t=t,
        names=names,
        position=position,
        valid=np.ones(position.shape[:2], dtype=bool),
        scene=scene,
        subject={"thigh": 0.4},
    )
    hand = contact("LHand", "table", 1.0, 0.1, 0.5)
    interval = ContactInterval(
        part="LHand", is_surface=True, t0=1.0, t1=2.0, contact=hand
    )
    bare = ContactSequence(
        source="made up",
        subject=None,
        scene=scene,
        stances=(Stance(contacts=(hand,)),),
        t=np.array([0.0, 4.0]),
    )
    found = replace(bare, intervals=(interval,))
    a = pixels(plots.demonstration_plot(demo, bare, tmp_path / "a.png"))
    b = pixels(plots.demonstration_plot(demo, found, tmp_path / "b.png"))
    changed = np.argwhere(np.any(a != b, axis=2))
    assert len(changed) > 100
    height, width, _ = a.shape
    assert changed[:, 0].max() < height / 2  # the left arm is the first panel
    assert changed[:, 1].max() < width / 2

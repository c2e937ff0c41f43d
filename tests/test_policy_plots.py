"""Pictures of a policy show what is in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from clamber.contact.learn import learn_policy
from clamber.contact.policy import GeneralPolicy
from clamber.show import policy_plots
from clamber.show.policy_plots import pelvis_plot, policy_plot, save_pictures
from test_contraction import crossing, posed


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that are saved."""
    saved: list[Figure] = []
    save = policy_plots.save_plot

    def keep(figure, path):
        saved.append(figure)
        return save(figure, path)

    monkeypatch.setattr(policy_plots, "save_plot", keep)
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
    assert shown.count("gives up") == demo.actions.count(None)


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

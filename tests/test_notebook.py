"""Records as cells of a notebook: a line, a picture, a table; and as pages."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clamber
from clamber.errors import ClamberError, InputError
from clamber.show import notebook


def pictures(cell: str) -> list[np.ndarray]:
    """(h, w, 3) of each picture in a cell."""
    found = re.findall(r"data:image/png;base64,([^\"]+)", cell)
    data = (io.BytesIO(base64.b64decode(x)) for x in found)
    return [np.asarray(Image.open(x).convert("RGB")).astype(int) for x in data]


def rows(cell: str) -> int:
    """Of the table, its head aside."""
    return cell.count("<tr>") - cell.count("<thead>")


def is_drawn(picture: np.ndarray) -> bool:
    """More than a few pixels are of another colour than the commonest one."""
    colours, count = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    return len(colours) > 8 and count.max() < 0.98 * count.sum()


def test_a_recording_and_its_contacts_are_drawn_and_tabled(demo_sequence: Any):
    demo = clamber.load_demo("climb")
    for record, least in ((demo, 5), (demo_sequence, len(demo_sequence.stances))):
        cell = record._repr_html_()
        (picture,) = pictures(cell)
        assert is_drawn(picture)
        assert rows(cell) >= least
        assert "synthetic" in cell
    blue = pictures(demo._repr_html_())[0]
    bones = (blue[..., 2] > 180) & (blue[..., 0] < 90)
    parts = np.array_split(bones, notebook.TILES + 2, axis=1)
    assert all(p.sum() > 60 for p in parts)  # a person at each of the times


@pytest.mark.parametrize("which", ["plan", "rollout"])
def test_the_robot_is_seen_in_the_cell_of_a_plan_and_of_a_run(
    which: str, one_hand_plan: Any, one_hand_rollout: Any
):
    record = one_hand_plan if which == "plan" else one_hand_rollout
    cell = record._repr_html_()
    (picture,) = pictures(cell)
    orange = (picture[..., 0] > 180) & (picture[..., 2] < 80)  # coman's hands and feet
    n = picture.shape[1] // notebook.TILE[0]
    assert n > 1
    assert all(p.sum() > 100 for p in np.array_split(orange, n, axis=1))
    if which == "plan":
        assert rows(cell) == len(one_hand_plan.keyframes)


def test_a_verdict_has_a_row_and_a_bar_for_each_criterion(
    one_hand_plan: Any, one_hand_rollout: Any
):
    verdict = clamber.judge(one_hand_plan, one_hand_rollout)
    first = next(iter(verdict.criteria))
    failed = replace(verdict.criteria[first], value=0.5, ok=False)
    wrong = replace(
        verdict, reached=False, criteria={**verdict.criteria, first: failed}
    )
    for v in (verdict, wrong):
        cell = v._repr_html_()
        (picture,) = pictures(cell)
        assert rows(cell) == len(v.criteria)
        red = (picture[..., 0] > 200) & (picture[..., 1] < 80)
        assert red.any() == any(not c.ok for c in v.criteria.values())


def test_without_opengl_there_is_a_cell_without_a_picture(
    monkeypatch: Any, one_hand_plan: Any
):
    def none(*args: Any, **kwargs: Any) -> Any:
        raise ClamberError("no OpenGL")

    monkeypatch.setattr(notebook, "Camera", none)
    cell = one_hand_plan._repr_html_()
    assert not pictures(cell)
    assert rows(cell) == len(one_hand_plan.keyframes)


def test_what_a_person_wrote_is_no_markup(demo_sequence: Any):
    named = replace(demo_sequence, source="<script>alert(1)</script>")
    assert "<script" not in named._repr_html_()


def test_a_plan_and_a_run_are_pages_in_the_browser(
    one_hand_plan: Any, one_hand_rollout: Any
):
    pytest.importorskip("viser")
    assert one_hand_rollout.plan is one_hand_plan
    for record in (one_hand_plan, one_hand_rollout):
        page = record.show()
        try:
            assert page.clock.end > 1.0
            assert page.url in repr(page)
            assert f'src="{page.url}"' in page._repr_html_()
        finally:
            page.close()
    loaded = replace(one_hand_rollout, plan=None)
    with pytest.raises(InputError, match="plan"):
        loaded.show()

from __future__ import annotations

import io
import sys

import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.report.pictures.palette import DARK, LEGEND, LIGHT

from .conftest import make_scenario, offset_path

pytest.importorskip("matplotlib")


def pixels(figure):
    from matplotlib.image import imread

    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    stream.seek(0)
    return np.round(imread(stream)[..., :3] * 255).astype(int)


def share(image, name, near=2, theme=LIGHT):
    wanted = [int(theme[name][i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=-1) <= near).sum())


def test_only_present_things_are_drawn():
    from drivax.report.pictures.drawing import draw_scenario

    scenario = make_scenario(0)
    early, late = (pixels(draw_scenario(scenario, step, legend=False)) for step in (10, 70))
    for name in ("ego", "vehicle", "cyclist", "parked", "edge", "lane", "crosswalk", "ground"):
        assert share(early, name) > 20, name
    assert share(early, "red") > 20 and share(early, "green") == 0, "a red light at step 10"
    assert share(late, "green") > 20, "green at step 70"
    assert (
        share(pixels(draw_scenario(scenario, 30, legend=False)), "pedestrian") > 5 > share(late, "pedestrian")
    )


def test_legend_has_every_colour_of_the_dark_theme():
    from drivax.report.pictures.drawing import draw_scenario

    scenario = make_scenario(0)
    plain = pixels(draw_scenario(scenario, 10, theme="dark", legend=False))
    image = pixels(draw_scenario(scenario, 10, theme="dark"))
    assert share(image, "ground", theme=DARK) > 0.5 * plain[..., 0].size and share(image, "ground") == 0
    below = image[len(plain) :]
    for name in {name for name, _ in LEGEND} - {"mark", "goal", "log"}:
        assert share(below, name, theme=DARK) > 15, name
    edges = np.abs(below - below[0, 0]).max(axis=-1) > 8
    assert not edges[:, :4].any() and not edges[:, -4:].any(), "the legend fits"


def test_path_moves_ego_and_leaves_the_log_dashed():
    from drivax.report.pictures.drawing import draw_scenario

    scenario = make_scenario(0)
    ego = offset_path(scenario, 20.0)
    image = pixels(draw_scenario(scenario, 60, ego))
    plain = pixels(draw_scenario(scenario, 60, offset_path(scenario, 0.0)))
    assert share(image, "log", near=25) > share(plain, "log", near=25) + 20 and share(image, "ego") > 50
    gone = ego.copy()
    gone[60:] = np.nan
    assert pixels(draw_scenario(scenario, 60, gone)).shape == image.shape


def test_impossible_step_and_missing_matplotlib_are_errors(monkeypatch):
    from drivax.report.pictures.drawing import draw_scenario

    with pytest.raises(UsageError, match="0 to 90"):
        draw_scenario(make_scenario(0), 91)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UsageError, match=r"drivax\[show\]"):
        draw_scenario(make_scenario(0), 10)

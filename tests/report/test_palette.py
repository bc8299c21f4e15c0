"""Neighbouring colours differ with every kind of colour vision."""

import itertools

import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.report.pictures.palette import LEGEND, SERIES, THEMES, stroke, theme_colours

#: Machado, Oliveira and Fernandes, IEEE TVCG 15 (2009), table 1, severity 1: how linear RGB is seen.
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}  # fmt: skip
#: Linear sRGB to XYZ under D65 (IEC 61966-2-1), and its white.
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
)
WHITE = XYZ.sum(axis=1)
CLASSES = ("ego", "vehicle", "pedestrian", "cyclist", "parked", "other")
LIGHTS = ("red", "amber", "green", "unknown")


def lab(colour, vision):
    """CIE L*a*b* of a hex colour under a kind of vision."""
    values = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    ratio = XYZ @ np.clip(np.asarray(VISION[vision]) @ linear, 0, 1) / WHITE
    root = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    return np.array([116 * root[1] - 16, 500 * (root[0] - root[1]), 200 * (root[1] - root[2])])


def distance(one, other, vision):
    return float(np.linalg.norm(lab(one, vision) - lab(other, vision)))


def test_reference_lab_values_of_black_white_and_red():
    np.testing.assert_allclose(lab("#ffffff", "normal"), (100, 0, 0), atol=1e-3)
    np.testing.assert_allclose(lab("#000000", "deuteranopia"), 0, atol=1e-9)
    np.testing.assert_allclose(lab("#ff0000", "normal"), (53.24, 80.09, 67.20), atol=0.02)  # CIE76, D65
    assert distance("#ff0000", "#8f7a00", "deuteranopia") < 0.4 * distance("#ff0000", "#8f7a00", "normal")


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("group", [CLASSES, LIGHTS])
def test_neighbouring_colours_differ(vision, theme, group):
    """The threshold is six times the just noticeable difference of 2.3 (Mahy et al. 1994)."""
    colours = THEMES[theme]
    for one, other in itertools.combinations(group, 2):
        assert distance(colours[one], colours[other], vision) > 14, (one, other)


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("theme", THEMES)
def test_all_colours_differ_from_the_ground(vision, theme):
    colours = THEMES[theme]
    for name in (*CLASSES, *LIGHTS, "edge", "lane", "line", "route", "log", "stop", "mark", "ink"):
        assert distance(colours[name], colours["ground"], vision) > 14, name


@pytest.mark.parametrize("vision", VISION)
def test_colours_of_chart_lines_differ(vision):
    assert min(distance(a, b, vision) for a, b in itertools.combinations(SERIES, 2)) > 14


def test_lines_beyond_six_are_dashed():
    strokes = [stroke(place) for place in range(18)]
    assert len({(one.colour, one.dash) for one in strokes}) == 18 and len({one.key for one in strokes}) == 18
    assert [one.colour for one in strokes[:6]] == list(SERIES) and not any(one.dash for one in strokes[:6])
    assert strokes[6].svg == f'stroke="{SERIES[0]}" stroke-dasharray="6 3"' and stroke(18) == strokes[0]


def test_legend_names_every_class_and_light():
    named = {name for name, _ in LEGEND}
    assert {*CLASSES, *LIGHTS, "route", "log", "stop", "goal", "mark"} == named
    assert set(THEMES["light"]) == set(THEMES["dark"])


def test_unknown_theme_is_refused():
    with pytest.raises(UsageError, match="unknown theme 'blue'; use light or dark"):
        theme_colours("blue")

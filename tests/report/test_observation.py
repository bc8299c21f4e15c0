"""The picture of an observation, and the table of its statistics."""

from __future__ import annotations

import io
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from drivax.errors import UsageError
from drivax.evaluation.observation_statistics import FeatureStatistics, ObservationStatistics
from drivax.report.inspection import observation_overview, observation_table
from drivax.tasks.features import Features
from drivax.tasks.observations import ObservationConfig

from .test_still import pixels, share

pytest.importorskip("matplotlib")

CONFIG = ObservationConfig(agents=3, steps=2, road=4, lights=2, route=3)


def observed(config=CONFIG):
    """A vehicle 10 m ahead that comes nearer, a pedestrian to its left, a lane piece, an edge, a red light, a route."""
    agents = np.zeros((3, 2, 12), np.float32)
    agents[0] = [10 / 50, 0, 0, 1, -5 / 15, 0, 4.8 / 5, 2 / 5, 1, 0, 0, 0]
    agents[0, 0, 0] = 14 / 50
    agents[1] = [10 / 50, 6 / 50, 1, 0, 0, 0, 0.2, 0.2, 0, 1, 0, 0]
    road = np.zeros((4, 10), np.float32)
    road[0] = [10 / 50, -4 / 50, 1, 0, 1, 1, 0, 0, 0.9, 1]
    road[1] = [10 / 50, -8 / 50, 1, 0, 1, 0, 1, 0, 0, 0]
    road[2] = [25 / 50, 0, 0, 1, 0.8, 0, 0, 1, 0, 0]
    lights = np.array([[20 / 50, 3 / 50, 0, 0, 0, 1, 1], [0] * 7], np.float32)
    route = np.array([[x / 50, -0.05, 0, 1, 0.9] for x in (5, 10, 15)], np.float32)
    return {
        "ego": np.array([[-1 / 50, 0, 0, 1, 0.6, 0], [0, 0, 0, 1, 0.6, 0]], np.float32),
        "ego_static": np.array([4.8 / 5, 2 / 5, 0.25, -0.5], np.float32),
        "agents": agents,
        "agents_mask": np.array([[True, True], [True, True], [False, False]]),
        "road": road,
        "road_mask": np.array([True, True, True, False]),
        "lights": lights,
        "lights_mask": np.array([True, False]),
        "route": route,
        "route_mask": np.ones(3, bool),
    }


def test_columns_are_split_with_their_units():
    from drivax.report.pictures.observation import ObservationGroups

    seen = ObservationGroups.of(CONFIG, observed())
    np.testing.assert_allclose(seen["agents", "position"][0], [[14, 0], [10, 0]], atol=1e-5)
    np.testing.assert_allclose(seen["agents", "velocity"][0, 1], [-5, 0], atol=1e-5)
    np.testing.assert_allclose(seen["agents", "length"][0, 1], [4.8], atol=1e-5)
    np.testing.assert_allclose(seen["road", "length"][:2, 0], [10, 10])
    np.testing.assert_allclose(seen["ego_static", "last_action"], [0.25, -0.5])
    assert (
        seen.has("lights", "state", "on_route") and not seen.has("agents", "height") and not seen.has("none")
    )


def test_only_observed_things_are_drawn():
    from drivax.report.pictures.observation import draw_observation

    full = observed()
    image = pixels(draw_observation(CONFIG, full, "a title"))
    signs = {"agents": ("vehicle", "pedestrian"), "road": ("edge",), "lights": ("red",), "route": ("route",)}
    for group, colours in signs.items():
        # The legend shows each sign once.
        without = pixels(
            draw_observation(
                CONFIG, full | {f"{group}_mask": np.zeros_like(full[f"{group}_mask"])}, "a title"
            )
        )
        for colour in colours:
            assert share(image, colour) > share(without, colour) + 25, colour
    littered = {name: np.array(value) for name, value in full.items()}
    littered["agents"][2], littered["road"][3], littered["lights"][1] = 0.3, 0.3, 0.3
    np.testing.assert_array_equal(pixels(draw_observation(CONFIG, littered, "a title")), image)


def test_small_observation_can_be_drawn():
    from drivax.report.pictures.observation import draw_observation

    features = Features(
        ego=("velocity",),
        ego_static=(),
        agents=("position",),
        road=("position",),
        lights=("position",),
        route=(),
    )
    lean = replace(CONFIG, features=features)
    full = observed()
    cut = {name: full[name] for name in ("agents_mask", "road_mask", "lights_mask")}
    cut |= {name: full[name][..., :2] for name in ("agents", "road", "lights")} | {"ego": full["ego"][:, 4:6]}
    figure = draw_observation(lean, cut)
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"agent", "road", "unknown light"} < labels
    assert labels.isdisjoint({"lane", "edge", "crosswalk", "red light", "light on the route"})
    image = pixels(figure)
    assert share(image, "vehicle") > 20 and share(image, "ego") > 20


def test_empty_picture_reaches_further_ahead_than_back():
    from drivax.report.pictures.observation import ObservationGroups, _extent

    low, high = _extent(ObservationGroups({}, {}))
    np.testing.assert_allclose((*low, *high), (-16, -12, 16, 24))


def test_missing_matplotlib_is_an_error(monkeypatch):
    from drivax.report.pictures.observation import draw_observation

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UsageError, match=r"drivax\[show\]"):
        draw_observation(CONFIG, observed())


def statistics(**more):
    one = FeatureStatistics("ego", "velocity ahead", 240, 0, 0.6, 0.004, -0.001, 1.239, -0.25, 1.2)
    other = FeatureStatistics("mine", "0", 0, 7, *(float("nan"),) * 6)
    groups = {"ego": 1.3, "mine": float("nan")}
    return ObservationStatistics(
        "shy", 40, 3, 320, **{"permuted": 320, "features": (one, other), "groups": groups} | more
    )


def printed(table):
    out = io.StringIO()
    Console(file=out, width=100).print(table.rich())
    return [line.split() for line in out.getvalue().splitlines()]


def test_table_has_a_row_per_feature():
    rows = printed(observation_table(statistics()))
    assert rows[0][-3:] == ["r", "collision", "importance"]
    assert rows[1:3] == [
        ["ego", "1.30"],
        ["velocity", "ahead", "240", "0.60", "0.00", "0.00", "1.24", "-0.25", "1.20"],
    ]
    assert rows[3:] == [["mine"], ["0", "0", "7"]]
    assert printed(observation_table(statistics(permuted=0)))[1] == ["ego"]
    text = observation_overview(statistics())
    assert text == "320 states of 40 episodes of shy, 3 with a collision; 7 entries are NaN or infinite"

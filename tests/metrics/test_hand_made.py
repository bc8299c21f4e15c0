"""Metrics of hand-made scenes against hand-computed values, and changes that must not affect metrics."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from drivax.metrics.catalogue import METRICS
from drivax.testing.worlds import rotate_recording
from judging import judge
from metric_scenes import scenes
from scenes import car, tracks

SCENES = scenes()


def differences(scene, result):
    """Return name, expected and computed value of each metric that differs from its expected value."""
    mismatches = []
    for name, value in scene.expected.items():
        actual = result[name]
        same = (
            value is None
            if actual is None
            else value is not None and actual == pytest.approx(value, rel=2e-3, abs=6e-3)
        )
        if not same:
            mismatches.append((name, value, actual))
    return mismatches


@pytest.fixture(scope="module")
def metrics_by_scene():
    result = judge([s.recording for s in SCENES.values()], [s.drive for s in SCENES.values()])
    return dict(zip(SCENES, result, strict=True))


@pytest.mark.parametrize("name", SCENES)
def test_values_by_hand(metrics_by_scene, name):
    assert differences(SCENES[name], metrics_by_scene[name]) == []


def test_every_metric_has_at_least_five_expected_values():
    counts = Counter(name for scene in SCENES.values() for name in scene.expected)
    few = {name: counts[name] for name in METRICS if counts[name] < 5}
    assert few == {}
    kinds = {name: {s.expected[name] for s in SCENES.values() if name in s.expected} for name in METRICS}
    assert [
        name for name, values in kinds.items() if len(values) < 2 and name not in ("steps", "last_step")
    ] == []


def turned(drive, angle):
    """The same motion in a world that is rotated by ``angle`` about ego's position at step 10."""
    if drive is None:
        return None

    def turn(motion, by):
        cos, sin = np.cos(by), np.sin(by)
        xy = motion[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        return np.concatenate([xy, motion[:, 2:3] + by, motion[:, 3:]], axis=1)

    return lambda log: turn(drive(turn(log, -angle)), angle)


def with_others(recording, change):
    """A recording with other agents changed by ``change``."""
    old = recording.tracks
    names = ("xy", "heading", "velocity", "valid", "kind")
    cars = [
        {name: getattr(old, name)[row] for name in names} | {"size": tuple(old.size[row, 0])}
        for row in range(len(old.valid))
    ]
    return replace(recording, tracks=tracks([cars[0], *change(cars[1:])]))


def shifted_and_turned(scene):
    return rotate_recording(scene.recording, 2.1, 4000.0, -7000.0), turned(scene.drive, 2.1)


def reversed_and_joined(scene):
    """The other agents in another order, among agents that are too far away to matter."""
    far = [car(100.0 + 9 * i, 3.7, 0.0, 20.0, steps=range(20, 80)) for i in range(5)]
    return with_others(scene.recording, lambda others: [*far[:2], *others[::-1], *far[2:]]), scene.drive


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("change", [shifted_and_turned, reversed_and_joined])
def test_irrelevant_changes_keep_every_metric(metrics_by_scene, change, every):
    some = dict(list(SCENES.items())[::every])
    pairs = [change(scene) for scene in some.values()]
    again = judge([recording for recording, _ in pairs], [drive for _, drive in pairs])
    for (name, scene), result in zip(some.items(), again, strict=True):
        # The mapped area is a box along the scenario's own axes: turning the world changes its corners.
        assert {d[0] for d in differences(scene, result)} <= {"left_map"}, name
        for metric in set(METRICS) - {"left_map"}:
            one, other = metrics_by_scene[name][metric], result[metric]
            assert (one is None) == (other is None), (name, metric)
            if one is not None:
                assert one == pytest.approx(other, rel=3e-3, abs=2e-2), (name, metric)


def test_step_values_accumulate_to_episode_metrics(metrics_by_scene):
    for name, result in metrics_by_scene.items():
        series = result["series"]
        assert all(len(values) == 80 for values in series.values()), name
        for metric, step in (("collision", "collision"), ("offroad", "offroad"), ("red_light", "red_light")):
            if result[metric] is not None:
                assert result[metric] == series[step].max(), (name, metric)
        assert result["distance"] == pytest.approx(series["distance"].sum(), abs=1e-2)
        if result["min_ttc"] is not None:
            assert result["min_ttc"] == pytest.approx(np.nanmin(series["ttc"]))
            assert result["average_ttc"] == pytest.approx(np.nanmean(series["ttc"]), abs=1e-4)
        else:
            assert np.isnan(series["ttc"]).all()
        if result["speeding_max"] is not None:
            assert result["speeding_max"] == pytest.approx(np.nanmax(series["speeding"]), abs=1e-5)
        first = np.flatnonzero(series["collision"])
        assert result["collision_step"] == (11 + first[0] if first.size else -1), name

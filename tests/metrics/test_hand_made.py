"""Every metric on hand-made scenes whose values can be worked out on paper, and what must change nothing."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from drivax.metrics.catalogue import METRICS
from judging import judge
from metric_scenes import scenes
from scenes import car, moved, tracks

SCENES = scenes()


def differences(scene, found):
    """What is not as expected: name, expected, found."""
    wrong = []
    for name, value in scene.expected.items():
        got = found[name]
        same = (
            value is None
            if got is None
            else value is not None and got == pytest.approx(value, rel=2e-3, abs=6e-3)
        )
        if not same:
            wrong.append((name, value, got))
    return wrong


@pytest.fixture(scope="module")
def judged():
    found = judge([s.recording for s in SCENES.values()], [s.drive for s in SCENES.values()])
    return dict(zip(SCENES, found, strict=True))


@pytest.mark.parametrize("name", SCENES)
def test_values_by_hand(judged, name):
    assert differences(SCENES[name], judged[name]) == []


def test_every_metric_has_at_least_five_expected_values():
    counts = Counter(name for scene in SCENES.values() for name in scene.expected)
    few = {name: counts[name] for name in METRICS if counts[name] < 5}
    assert few == {}
    kinds = {name: {s.expected[name] for s in SCENES.values() if name in s.expected} for name in METRICS}
    assert [
        name for name, values in kinds.items() if len(values) < 2 and name not in ("steps", "last_step")
    ] == []


def turned(drive, angle):
    """The same way of driving in a world that is turned by ``angle`` about ego's place at step 10."""
    if drive is None:
        return None

    def turn(motion, by):
        cos, sin = np.cos(by), np.sin(by)
        xy = motion[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        return np.concatenate([xy, motion[:, 2:3] + by, motion[:, 3:]], axis=1)

    return lambda log: turn(drive(turn(log, -angle)), angle)


def with_others(recording, change):
    """A recording whose others are those that ``change`` makes of them."""
    old = recording.tracks
    names = ("xy", "heading", "velocity", "valid", "kind")
    cars = [
        {name: getattr(old, name)[row] for name in names} | {"size": tuple(old.size[row, 0])}
        for row in range(len(old.valid))
    ]
    return replace(recording, tracks=tracks([cars[0], *change(cars[1:])]))


def shifted_and_turned(scene):
    return moved(scene.recording, 2.1, 4000.0, -7000.0), turned(scene.drive, 2.1)


def reversed_and_joined(scene):
    """The others in another order, among agents that are too far away to matter."""
    far = [car(100.0 + 9 * i, 3.7, 0.0, 20.0, steps=range(20, 80)) for i in range(5)]
    return with_others(scene.recording, lambda others: [*far[:2], *others[::-1], *far[2:]]), scene.drive


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("change", [shifted_and_turned, reversed_and_joined])
def test_irrelevant_changes_keep_every_metric(judged, change, every):
    some = dict(list(SCENES.items())[::every])
    pairs = [change(scene) for scene in some.values()]
    again = judge([recording for recording, _ in pairs], [drive for _, drive in pairs])
    for (name, scene), found in zip(some.items(), again, strict=True):
        # The mapped area is a box along the scenario's own axes: turning the world changes its corners.
        assert {d[0] for d in differences(scene, found)} <= {"left_map"}, name
        for metric in set(METRICS) - {"left_map"}:
            one, other = judged[name][metric], found[metric]
            assert (one is None) == (other is None), (name, metric)
            if one is not None:
                assert one == pytest.approx(other, rel=3e-3, abs=2e-2), (name, metric)


def test_step_values_accumulate_to_episode_metrics(judged):
    """Step values are the numbers that episodes are made of."""
    for name, found in judged.items():
        series = found["series"]
        assert all(len(values) == 80 for values in series.values()), name
        for metric, step in (("collision", "collision"), ("offroad", "offroad"), ("red_light", "red_light")):
            if found[metric] is not None:
                assert found[metric] == series[step].max(), (name, metric)
        assert found["distance"] == pytest.approx(series["distance"].sum(), abs=1e-2)
        if found["min_ttc"] is not None:
            assert found["min_ttc"] == pytest.approx(np.nanmin(series["ttc"]))
            assert found["average_ttc"] == pytest.approx(np.nanmean(series["ttc"]), abs=1e-4)
        else:
            assert np.isnan(series["ttc"]).all()
        if found["speeding_max"] is not None:
            assert found["speeding_max"] == pytest.approx(np.nanmax(series["speeding"]), abs=1e-5)
        first = np.flatnonzero(series["collision"])
        assert found["collision_step"] == (11 + first[0] if first.size else -1), name

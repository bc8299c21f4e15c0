"""Criticality of hand-made scenes, worked out on paper; the constant speeds make every step's formula short."""

from dataclasses import replace

import numpy as np
import pytest

from drivax.curation import kinematic
from drivax.curation.kinematic import KinematicConfig, kinematic_steps, score_kinematic
from drivax.errors import UsageError
from drivax.scenario.assemble import assemble
from drivax.scenario.schema import AgentKind, Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenes import bank_of, car, moved, straight_road

NOW = 10  # where `car` puts everyone at (x, y)
CONFIG = KinematicConfig()

SCENES = {
    "free": [car(speed=15.0)],
    "stopped": [car(speed=15.0), car(x=10.0)],
    "oncoming": [car(speed=15.0), car(x=100.0, y=3.7, heading=np.pi, speed=15.0)],
    "leader": [car(speed=15.0), car(x=30.0, speed=10.0)],
    "beside": [car(speed=15.0), car(x=8.0, y=3.7, speed=5.0)],
    "follower": [car(speed=5.0), car(x=-12.0, speed=15.0)],
    "pedestrian": [
        car(speed=10.0),
        car(x=20.0, y=-4.0, heading=np.pi / 2, speed=1.6, length=0.8, width=0.8, kind=AgentKind.PEDESTRIAN),
    ],
    "far": [car(speed=15.0), car(x=60.0)],
    "standing": [car(), car(x=10.0)],
    "brief": [car(speed=15.0, steps=range(12)), car(x=60.0)],
    **{f"gap {gap}": [car(speed=9.0), car(x=4.8 + gap)] for gap in (15.0, 20.0, 30.0, 40.0)},
    **{f"speed {speed}": [car(speed=speed), car(x=24.8)] for speed in (5.0, 8.0, 11.0, 14.0)},
}


@pytest.fixture(scope="module")
def steps():
    bank = bank_of(*(straight_road(cars) for cars in SCENES.values()))
    return dict(zip(SCENES, np.asarray(kinematic_steps(CONFIG, bank)), strict=True))


def expected(ttc_s, braking_mps2, config=CONFIG):
    urgent = np.clip((1 / ttc_s - 1 / 5) / (1 / config.urgent_s - 1 / 5), 0, 1)
    return (urgent + min(braking_mps2 / config.full_braking_mps2, 1)) / 2


def test_a_stopped_car_ahead_is_critical_and_an_oncoming_one_in_its_lane_is_not(steps):
    """The published heuristic scores these two 0.15 and 1.00."""
    assert steps["stopped"][NOW] == 1.0  # 5.2 m at 15 m/s: 0.35 s, 21.6 m/s2
    assert steps["oncoming"].max() < 0.01
    assert steps["free"].max() < 0.01


def test_hand_computed_values(steps):
    gap = 30.0 - 4.8
    assert steps["leader"][NOW] == pytest.approx(expected(5.0, 5.0**2 / (2 * gap)), abs=1e-3)
    # A second later 5 m nearer: 4.04 s and 0.62 m/s2.
    assert steps["leader"][NOW + 10] == pytest.approx(expected((gap - 5) / 5, 25 / (2 * (gap - 5))), abs=1e-3)
    # Ego's front reaches a pedestrian 17.2 m ahead after 1.72 s, when it is at y = -1.25, within the car's 1 m + 0.4 m.
    assert steps["pedestrian"][NOW] == pytest.approx(expected(1.72, 0.0), abs=1e-3)
    assert steps["far"][NOW] == pytest.approx(expected((60 - 4.8) / 15, 15**2 / (2 * (60 - 4.8))), abs=1e-3)


def test_every_step_of_an_approach(steps):
    """From 74 m away to nearly there: no seam where one query of the route ends and the next begins."""
    at = np.arange(3, 45)
    gap = 60.0 - 4.8 - 15.0 * (at - NOW) * 0.1
    wanted = [expected(g / 15.0, 15.0**2 / (2 * g)) for g in gap]
    np.testing.assert_allclose(steps["far"][at], wanted, atol=1e-3)


def test_who_is_not_in_the_way_does_not_count(steps):
    assert steps["beside"].max() < 0.01
    assert steps["follower"][NOW] < 0.01
    assert steps["standing"].max() == 0.0


def test_nearer_and_faster_is_more_critical(steps):
    near, fast = ([steps[name][NOW] for name in SCENES if name.startswith(kind)] for kind in ("gap", "speed"))
    assert len(near) == len(fast) == 4
    assert (np.diff(near) < 0).all() and (np.diff(fast) > 0).all()
    assert min(near) > 0 and max(fast) < 1


def test_invariant_to_shifting_and_turning_the_world(steps):
    names = ("leader", "pedestrian", "far", "beside")
    turned = bank_of(*(moved(straight_road(SCENES[name]), 2.1, 300.0, -70.0) for name in names))
    for name, score in zip(names, np.asarray(kinematic_steps(CONFIG, turned)), strict=True):
        np.testing.assert_allclose(score, steps[name], atol=5e-3, err_msg=name)


def test_steps_where_ego_is_not_there_score_nothing(steps):
    np.testing.assert_allclose(steps["brief"][:12], steps["far"][:12], atol=1e-4)
    assert (steps["brief"][:12] > 0).all() and (steps["brief"][12:] == 0).all()


def test_a_set_larger_than_a_batch_scores_the_same(tmp_path, steps, monkeypatch):
    """Padded and batched, against the trimmed bank of all."""
    monkeypatch.setattr(kinematic, "BATCH", 4)
    names = list(SCENES)[:6]
    with ScenarioWriter(tmp_path / "set", Capacity()) as writer:
        for name in names:
            writer.add(assemble(replace(straight_road(SCENES[name]), scenario_id=name)))
    done = []
    scores = score_kinematic(ScenarioSet.open(tmp_path / "set"), CONFIG, lambda *at: done.append(at))
    assert done == [(4, 6), (6, 6)]
    np.testing.assert_allclose(scores, np.stack([steps[name] for name in names]), atol=1e-5)


@pytest.mark.parametrize(
    "wrong", [{"urgent_s": 0.0}, {"urgent_s": 5.0}, {"full_braking_mps2": 0.0}, {"urgent_s": float("nan")}]
)
def test_scales_are_checked(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        KinematicConfig(**wrong)

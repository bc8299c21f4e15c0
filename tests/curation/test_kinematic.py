"""Criticality of hand-made scenes against hand-computed values; constant speeds keep formulas short."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from drivax.curation import logged as scoring
from drivax.curation.kinematic import KinematicConfig, post_encroachment_time
from drivax.curation.logged import score_bank, score_steps
from drivax.curation.methods import KINEMATIC
from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind, Capacity
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.testing.worlds import rotate_recording
from scenes import bank_of, car, straight_road

NOW = 10  # the step at which `car` is at (x, y)
CONFIG = KinematicConfig()

TIME = (np.arange(91) - NOW) * 0.1
NOISE = np.random.default_rng(0).standard_normal(91)


def with_speeds(speeds):
    """A car that drives straight on at given speeds."""
    along = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * 0.1)])
    track = car()
    return track | {
        "xy": np.stack([along - along[NOW], np.zeros(91)], -1),
        "velocity": np.stack([speeds, np.zeros(91)], -1),
    }


def turning(heading):
    """A car at 5 m/s with given headings; its position does not matter."""
    track = car(speed=5.0)
    return track | {"heading": heading, "velocity": 5.0 * np.stack([np.cos(heading), np.sin(heading)], -1)}


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
    "waiting": [car(), car(x=25.0, heading=np.pi, speed=10.0, steps=range(28))],
    "letting pass": [car(), car(x=8.0, y=-6.0, heading=np.pi / 2 + 0.5, speed=5.0, steps=range(28))],
    "head on": [car(speed=5.0), car(x=40.0, heading=np.pi, speed=10.0, steps=range(28))],
    "brief": [car(speed=15.0, steps=range(12)), car(x=60.0)],
    "noise": [with_speeds(10.0 + 0.01 * NOISE)],
    "jerk": [with_speeds(10.0 + 4.13 / 2 * (TIME - 4.5) ** 2)],
    "bend": [turning(0.3 * TIME**2)],
    "aside": [car(y=0.5, speed=10.0)],
    "kerb": [car(y=-0.5, speed=10.0)],
    "verge": [car(y=-1.2, speed=10.0)],
    "field": [car(y=-8.0, speed=10.0)],
    "off the map": [car(y=-30.0, speed=10.0)],
    "crowd": [car(speed=10.0), *(car(x=-60.0 - 8.0 * i, y=3.7) for i in range(7))],
    "appears inside": [car(speed=10.0), car(x=1.0, speed=10.0)],
    **{f"gap {gap}": [car(speed=9.0), car(x=4.8 + gap)] for gap in (15.0, 20.0, 30.0, 40.0)},
    **{f"speed {speed}": [car(speed=speed), car(x=24.8)] for speed in (5.0, 8.0, 11.0, 14.0)},
}


@pytest.fixture(scope="module")
def components():
    """Components by scene and name."""
    bank = bank_of(*(straight_road(cars) for cars in SCENES.values()))
    result = {name: np.asarray(part) for name, part in score_bank(CONFIG, bank).items()}
    return {scene: {name: part[row] for name, part in result.items()} for row, scene in enumerate(SCENES)}


def conflict(result):
    return (result["urgency"] + result["braking"]) / 2


@pytest.fixture(scope="module")
def steps(components):
    """Mean of urgency and braking by scene."""
    return {scene: conflict(result) for scene, result in components.items()}


def expected(ttc_s, braking_mps2, config=CONFIG):
    urgent = np.clip((1 / ttc_s - 1 / 5) / (1 / config.urgent_s - 1 / 5), 0, 1)
    return (urgent + min(braking_mps2 / config.full_braking_mps2, 1)) / 2


def test_stopped_car_ahead_is_critical_and_oncoming_car_is_not(steps):
    """The published heuristic scores these two 0.15 and 1.00."""
    assert steps["stopped"][NOW] == 1.0  # 5.2 m at 15 m/s: 0.35 s, 21.6 m/s2
    assert steps["oncoming"].max() < 0.01
    assert steps["free"].max() < 0.01


def test_components_equal_hand_computed_values(steps):
    gap = 30.0 - 4.8
    assert steps["leader"][NOW] == pytest.approx(expected(5.0, 5.0**2 / (2 * gap)), abs=1e-3)
    # A second later 5 m nearer: 4.04 s and 0.62 m/s2.
    assert steps["leader"][NOW + 10] == pytest.approx(expected((gap - 5) / 5, 25 / (2 * (gap - 5))), abs=1e-3)
    # Ego's front reaches a pedestrian 17.2 m ahead after 1.72 s, when it is at y = -1.25, within the car's 1 m + 0.4 m.
    assert steps["pedestrian"][NOW] == pytest.approx(expected(1.72, 0.0), abs=1e-3)
    assert steps["far"][NOW] == pytest.approx(expected((60 - 4.8) / 15, 15**2 / (2 * (60 - 4.8))), abs=1e-3)


def test_every_step_of_an_approach(steps):
    """From a gap of 66 m to one of 4 m, without a discontinuity between the two route windows."""
    at = np.arange(3, 45)
    gap = 60.0 - 4.8 - 15.0 * (at - NOW) * 0.1
    reference = [expected(g / 15.0, 15.0**2 / (2 * g)) for g in gap]
    np.testing.assert_allclose(steps["far"][at], reference, atol=1e-3)


def test_agents_off_the_path_do_not_count(steps):
    assert steps["beside"].max() < 0.01
    assert steps["follower"][NOW] < 0.01
    assert steps["standing"].max() == 0.0


def test_oncoming_agent_counts_as_standing(components):
    """Braking does not reduce the other agent's part of the closing speed, and a standing car cannot brake."""
    for scene in ("waiting", "letting pass"):
        assert components[scene]["braking"].max() == components[scene]["urgency"].max() == 0.0
    reference = 5.0**2 / (2 * (40.0 - 4.8)) / CONFIG.full_braking_mps2
    assert components["head on"]["braking"][NOW] == pytest.approx(reference, abs=1e-3)


def test_nearer_and_faster_is_more_critical(steps):
    near, fast = ([steps[name][NOW] for name in SCENES if name.startswith(kind)] for kind in ("gap", "speed"))
    assert len(near) == len(fast) == 4
    assert (np.diff(near) < 0).all() and (np.diff(fast) > 0).all()
    assert min(near) > 0 and max(fast) < 1


def test_invariant_to_shifting_and_turning_the_world(components):
    names = ("leader", "pedestrian", "far", "beside", "kerb")
    turned = bank_of(*(rotate_recording(straight_road(SCENES[name]), 2.1, 300.0, -70.0) for name in names))
    for name, part in score_bank(CONFIG, turned).items():
        for row, scene in enumerate(names):
            np.testing.assert_allclose(
                part[row], components[scene][name], atol=5e-3, err_msg=f"{scene} {name}"
            )


def test_last_motion_is_repeated_where_ego_is_missing(steps):
    np.testing.assert_allclose(steps["brief"][:12], steps["far"][:12], atol=1e-4)
    assert (steps["brief"][:12] > 0).all()


def test_speed_noise_of_one_cm_per_s_is_negligible(components):
    """A fit over 1.5 s removes most of it; the published heuristic scores the same noise 0.6."""
    assert components["noise"]["volatility"].max() < 0.02


def test_jerk_and_yaw_acceleration(components):
    """Constant values, which the fitted polynomials reproduce: half of twice nuPlan's limit, and 0.6 rad/s2."""
    np.testing.assert_allclose(components["jerk"]["volatility"], 0.5, atol=2e-3)
    np.testing.assert_allclose(components["bend"]["volatility"], 0.6 / (2 * 1.93), atol=2e-3)


BRAKING = 30.0 - 2.0 * (TIME + 1.0)


@pytest.mark.parametrize("present", [range(5, 91), range(51), {*range(91)} - {*range(40, 50)}, range(2, 16)])
@pytest.mark.parametrize(("speeds", "jerk"), [(BRAKING, 0.0), (20.0 + 4.13 / 2 * (TIME - 4.5) ** 2, 0.5)])
def test_volatility_ignores_steps_without_ego(present, speeds, jerk):
    """Constant deceleration or jerk up to the last valid step; 0 without 1.5 s of valid steps."""
    valid = np.isin(np.arange(91), list(present))
    track = with_speeds(speeds)
    bank = bank_of(straight_road([track | {"valid": valid}]))
    result = np.asarray(score_bank(CONFIG, bank)["volatility"][0])
    acts = valid & np.roll(valid, -1)
    acts[-1] = acts[-2]
    reference = jerk if valid.sum() > 15 else 0.0
    np.testing.assert_allclose(result, np.where(acts, reference, 0.0), atol=3e-3)


def test_volatility_is_of_the_next_action():
    """The speed jumps between steps 50 and 51, the action of step 50, where the window is centred."""
    speeds = np.where(np.arange(91) <= 50, 10.0, 10.2)
    bank = bank_of(straight_road([with_speeds(speeds)]))
    result = np.asarray(score_bank(CONFIG, bank)["volatility"][0])
    # The slope of a line through 15 values of which one is 2 m/s2, k steps from the middle: 2 k / 280 per step.
    reference = [2.0 * abs(k) / 280 / 0.1 / (2 * 4.13) if abs(k) <= 7 else 0.0 for k in range(-10, 11)]
    np.testing.assert_allclose(result[40:61], reference, atol=1e-3)


def test_distances_are_to_segments(components):
    """The kerb is at y = -1.85, the lanes' centres at y = 0 and 3.7; the car is 2 m wide."""
    assert components["aside"]["lane_deviation"][NOW] == pytest.approx(0.5 / 1.25, abs=1e-3)
    assert components["aside"]["off_road"].max() == 0.0
    assert components["kerb"]["off_road"][NOW] == pytest.approx(1 - 0.35 / 0.75, abs=1e-3)
    assert components["verge"]["off_road"][NOW] == 1.0
    # Beyond the edge cut-off the stored side of the grid cell decides; off the map the car counts as on the road.
    assert (components["field"]["off_road"] == 1.0).all()
    nowhere = components["off the map"]
    assert nowhere["off_road"].max() == 0.0 and nowhere["lane_deviation"].max() == 0.0


def test_density_counts_all_agents(components):
    np.testing.assert_allclose(components["crowd"]["density"], 8 / 50)


def test_agents_that_appear_overlapping_are_ignored(steps):
    assert steps["appears inside"].max() == 0.0


def test_default_weights_rank_stopped_above_oncoming_car(components):
    """The published heuristic ranks them in the opposite order."""
    valid = np.ones((2, 91), bool)
    both = {
        name: np.stack([components[scene][name] for scene in ("stopped", "oncoming")])
        for name in components["stopped"]
    }
    scored, scenarios = KINEMATIC.combine(both, valid)
    assert sum(KINEMATIC.weights.values()) == pytest.approx(1.0)
    assert scored[0, NOW] > 0.25 and scored[1].max() < 0.01 and scenarios[0] > 2 * scenarios[1]


@pytest.mark.slow
def test_batches_do_not_change_scores(tmp_path, components, monkeypatch):
    """Scores of batches equal those of a single bank."""
    monkeypatch.setattr(scoring, "BATCH", 4)
    names = list(SCENES)[:6]
    with ScenarioWriter(tmp_path / "set", Capacity()) as writer:
        for name in names:
            writer.add(assemble(replace(straight_road(SCENES[name]), scenario_id=name)))
    done = []
    scores = score_steps(ScenarioSet.open(tmp_path / "set"), CONFIG, lambda *at: done.append(at))
    assert done == [(4, 6), (6, 6)]
    for name, part in scores.items():
        np.testing.assert_allclose(part, np.stack([components[s][name] for s in names]), atol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"urgent_s": 0.0}, {"urgent_s": 5.0}, {"full_braking_mps2": 0.0}, {"urgent_s": float("nan")},
        {"edge_m": -1.0}, {"crowd": 0},
    ],
)  # fmt: skip
def test_scales_are_checked(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        KinematicConfig(**wrong)


def crossing(step, speed=5.0, **others):
    """A car that crosses ego's path at x = 20.4 m upwards, with its centre on the path at a step."""
    return car(x=20.4, y=-(step - NOW) * 0.1 * speed, heading=np.pi / 2, speed=speed, **others)


@pytest.mark.parametrize(
    ("cars", "gap_s", "begin", "end"),
    [
        # The crossing car is within 3.4 m of the path's line for 6 steps before and after. Ego's front reaches 20 m at
        # step 28, its rear has left 21 m at step 34.
        ([car(speed=10.0), crossing(10)], 1.2, 0, 28),
        ([car(speed=10.0), crossing(50)], 1.0, 8, 44),
        ([car(speed=10.0), crossing(32)], 0.0, 8, 28),
        ([car(speed=10.0), crossing(5), crossing(50)], 1.0, 8, 44),
        ([car(speed=10.0), crossing(10, speed=0.0)], None, 0, 0),
        ([car(speed=10.0), car(x=30.0, speed=10.0)], None, 0, 0),
        ([car(speed=10.0), car(x=40.0, y=3.7, heading=np.pi, speed=10.0)], None, 0, 0),
        ([car(speed=2.0), crossing(10)], None, 0, 0),
    ],
)
def test_post_encroachment_time_of_crossing_cars(cars, gap_s, begin, end):
    bank = bank_of(straight_road(cars))
    values = np.asarray(score_bank(PostEncroachment(), bank)["time"])[0]
    if gap_s is None:
        assert np.isinf(values).all()
        return
    assert values.min() == pytest.approx(gap_s, abs=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(values == values.min()), np.arange(max(begin, 0), end + 1))
    score = np.asarray(score_bank(CONFIG, bank)["encroachment"])[0]
    np.testing.assert_allclose(score, np.clip(1.0 - values / 1.5, 0.0, 1.0), atol=1e-6)


@dataclass(frozen=True)
class PostEncroachment:
    """The time alone, as a score function."""

    def __call__(self, bank, log):
        return {"time": post_encroachment_time(bank, log)}

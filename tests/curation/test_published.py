"""The published heuristic, and its weaknesses."""

import numpy as np
import pytest

from drivax.curation.kinematic import PublishedConfig
from drivax.curation.logged import score_bank
from drivax.curation.methods import PUBLISHED
from drivax.errors import UsageError
from scenes import bank_of, car, straight_road

NOW = 10
NOISE = 0.01 * np.random.default_rng(0).standard_normal(91)


def ego(speeds=None, heading=None):
    """A car with these speeds or headings; its position does not matter."""
    track = car(speed=10.0)
    speeds = np.full(91, 10.0) if speeds is None else speeds
    heading = np.zeros(91) if heading is None else heading
    return track | {
        "heading": (heading + np.pi) % (2 * np.pi) - np.pi,
        "velocity": speeds[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1),
    }


STEPS = np.arange(91)
SPEEDS = 10.0 + 0.01 * np.cumsum(
    np.where(STEPS >= 40, STEPS - 40, 0)
)  # acceleration grows by 0.1 m/s2 per step
SCENES = {
    "noise": [ego(10.0 + NOISE)],
    "jerk": [ego(SPEEDS)],
    "yaw": [ego(heading=3.0 + 0.003 * np.maximum(STEPS - 40, 0) ** 2)],  # crosses pi; 0.6 rad/s2
    "oncoming": [car(speed=15.0), car(x=100.0, y=3.7, heading=np.pi, speed=15.0)],
    "stopped": [car(speed=15.0), car(x=10.0)],
    "leaves": [car(speed=5.0), car(x=30.0, speed=10.0)],
    "aside": [car(y=0.5, x=0.1, speed=10.0)],
    "kerb": [car(y=-1.6, x=0.1, speed=10.0)],
    "crowd": [car(speed=10.0), *(car(x=-60.0 - 8.0 * i, y=3.7) for i in range(7))],
}


@pytest.fixture(scope="module")
def result():
    bank = bank_of(*(straight_road(cars) for cars in SCENES.values()))
    parts = {name: np.asarray(part) for name, part in score_bank(PublishedConfig(), bank).items()}
    return {scene: {name: part[row] for name, part in parts.items()} for row, scene in enumerate(SCENES)}


def test_volatility_is_two_backward_differences(result):
    """Jerk of 0.1 m/s2 per 0.1 s from the second difference on, one step after the changed action."""
    jerk = result["jerk"]["volatility"]
    np.testing.assert_allclose(jerk[41:], 1.0 / 2.5, atol=2e-3)
    np.testing.assert_allclose(jerk[:41], 0.0, atol=2e-3)
    yaw = result["yaw"]["volatility"]
    assert yaw[60] == pytest.approx(0.6 / 1.5, abs=5e-3) and yaw[:40].max() < 5e-3


def test_differences_are_zero_at_the_start():
    """The speed before the log is that of its first step."""
    speeds = np.where(STEPS == 0, 10.0, 10.1)
    bank = bank_of(straight_road([ego(speeds)]))
    volatility = np.asarray(score_bank(PublishedConfig(), bank)["volatility"][0])
    assert volatility[0] == 0.0 and volatility[1] == volatility[2] == 1.0 and volatility[3] < 2e-3


def test_speed_noise_of_one_cm_per_s_scores_high(result):
    """The study's functions gave 0.62; the deviation of the second difference is sqrt(6) sigma / dt^2 = 2.4 m/s3."""
    expected = np.abs(np.diff(np.diff(10.0 + NOISE))) / 0.01 / 2.5
    np.testing.assert_allclose(result["noise"]["volatility"][2:], np.minimum(expected, 1.0), atol=2e-3)
    assert 0.5 < result["noise"]["volatility"].mean() < 0.75


def test_interaction_grows_with_distance(result):
    """100 m x 30 m/s is 3,000 and saturates; 10 m x 15 m/s is 150, and the car is hit in 0.35 s."""
    assert result["oncoming"]["interaction"][NOW] == 1.0
    assert result["stopped"]["interaction"][NOW] == pytest.approx(0.15, abs=1e-4)
    assert result["leaves"]["interaction"].max() == 0.0
    scores = [
        PUBLISHED.weights["interaction"] * result[name]["interaction"][NOW]
        for name in ("oncoming", "stopped")
    ]
    assert scores[0] > 6 * scores[1]


def test_distances_are_to_points(result):
    """The nearest point of the lane is 0.5 m to the side of ego and up to 0.25 m along, so the distance oscillates."""
    deviation = result["aside"]["lane_deviation"] * 1.25
    assert deviation.min() == pytest.approx(0.5, abs=2e-2)
    assert deviation.max() == pytest.approx(np.hypot(0.5, 0.25), abs=1e-2)
    near = 1 - result["kerb"]["off_road"]
    assert near.min() * 0.75 >= 0.25 - 1e-3 and near.max() * 0.75 <= np.hypot(0.25, 0.25) + 1e-3
    assert result["aside"]["off_road"].max() == 0.0


def test_published_density_is_agents_over_50(result):
    np.testing.assert_allclose(result["crowd"]["density"], 8 / 50)


def test_scores_of_steps_and_scenarios(result):
    """Weights .40/.05/.05/.47/.03; scenarios use 99th percentiles, a standard deviation and the mean density."""
    parts = {name: part[None] for name, part in result["kerb"].items()}
    steps, scenarios = PUBLISHED.combine(parts, np.ones((1, 91), bool))
    v, i, o, d, n = (
        result["kerb"][name]
        for name in ("volatility", "interaction", "off_road", "lane_deviation", "density")
    )
    np.testing.assert_allclose(steps[0], 0.40 * v + 0.05 * i + 0.05 * o + 0.47 * d + 0.03 * n, atol=1e-6)
    p99 = [np.percentile(part, 99) for part in (v, i, o)]
    expected = 0.40 * p99[0] + 0.05 * p99[1] + 0.05 * p99[2] + 0.47 * d.std() + 0.03 * n.mean()
    assert scenarios[0] == pytest.approx(expected, abs=1e-6)


def test_scales_are_checked():
    with pytest.raises(UsageError, match="lane_m"):
        PublishedConfig(lane_m=0.0)

"""Aggregators and weighted sums against other implementations."""

import numpy as np
import pytest

from drivax.curation.scores import Combination, aggregate
from drivax.errors import UsageError

RNG = np.random.default_rng(3)
STEPS = RNG.random((6, 40))
VALID = RNG.random((6, 40)) < 0.7
VALID[4] = False  # no valid step
VALID[5] = np.arange(40) == 7  # one valid step


def by_hand(name, values):
    if not len(values):
        return 0.0
    if name.startswith("top"):
        return np.mean(sorted(values)[-int(name[3:]) :])
    if name.startswith("p"):
        return np.percentile(values, int(name[1:]))
    return {"max": np.max, "mean": np.mean, "std": np.std}[name](values)


@pytest.mark.parametrize("name", ["max", "mean", "std", "p0", "p50", "p99", "p100", "top1", "top10", "top99"])
def test_aggregators_equal_hand_computed_values_of_valid_steps(name):
    expected = [by_hand(name, steps[valid]) for steps, valid in zip(STEPS, VALID, strict=True)]
    np.testing.assert_allclose(aggregate(STEPS, VALID, name), expected, atol=1e-12)
    # Values of invalid steps have no effect.
    np.testing.assert_array_equal(
        aggregate(np.where(VALID, STEPS, 9.0), VALID, name), aggregate(STEPS, VALID, name)
    )


def test_step_scores_are_weighted_means():
    """The sum of the weights does not matter, and no score is clipped."""
    components = {"a": STEPS, "b": STEPS[::-1], "unused": STEPS}
    steps, scenarios = Combination({"a": 0.9, "b": 0.3}, "mean").combine(components, VALID)
    expected = np.where(VALID, 0.75 * STEPS + 0.25 * STEPS[::-1], 0.0)
    np.testing.assert_allclose(steps, expected)
    np.testing.assert_allclose(scenarios, aggregate(expected, VALID, "mean"))


def test_components_have_their_own_aggregators():
    components = {"a": STEPS, "b": STEPS[::-1]}
    both = Combination({"a": 0.6, "b": 0.3}, {"a": "p90", "b": "std"})
    expected = (2 * aggregate(STEPS, VALID, "p90") + aggregate(STEPS[::-1], VALID, "std")) / 3
    np.testing.assert_allclose(both.combine(components, VALID)[1], expected)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (({"a": -1.0},), "weight of 'a' is -1.0"),
        (({"a": float("nan")},), "weight of 'a' is nan"),
        (({"a": 0.0},), "all weights are 0"),
        (({},), "all weights are 0"),
        (({"a": 1.0}, "median"), "unknown aggregator 'median'; use max, mean"),
        (({"a": 1.0}, "p101"), "unknown aggregator 'p101'"),
        (({"a": 1.0}, "top0"), "unknown aggregator 'top0'"),
        (({"a": 1.0, "b": 1.0}, {"a": "max"}), "missing aggregator for 'b'"),
        (({"a": 1.0}, {"a": "best"}), "unknown aggregator 'best'"),
    ],
)
def test_invalid_arguments_are_refused(arguments, words):
    with pytest.raises(UsageError, match=words):
        Combination(*arguments)

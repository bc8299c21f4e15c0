"""Weights and statistics of draws against closed forms."""

import numpy as np
import pytest

from drivax.curation.scores import ScoreTable
from drivax.curation.weights import PUBLISHED, WeightConfig, draw_statistics, permute_scores, sampling_weights
from drivax.errors import UsageError
from drivax.stats.intervals import effective_size

RNG = np.random.default_rng(1)


def make_table(steps, valid=None, scenarios=None):
    steps = np.asarray(steps, np.float64)
    valid = np.ones(steps.shape, bool) if valid is None else valid
    ids = tuple(map(str, range(len(steps))))
    scenarios = steps.max(axis=1) if scenarios is None else np.asarray(scenarios, np.float64)
    return ScoreTable("made", {}, "hash", ids, valid, np.where(valid, steps, 0.0), scenarios)


def plain(**changes):
    """Weights in proportion to the scores, with some settings changed."""
    settings = {"normalise": "none", "temperature": 1.0, "most": float("inf"), "uniform": 0.0}
    return WeightConfig(**(settings | changes))


TABLE = make_table(RNG.permutation(2000 * 51).reshape(2000, 51) / (2000 * 51))
DRAWN = TABLE.drawable


@pytest.mark.parametrize("temperature", [1.0, 0.5, 2.0])
def test_quantiles_to_a_power(temperature):
    """For uniform u in (0, 1), u^k has mean 1/(k+1) and mean square 1/(2k+1): an effective share of (2k+1)/(k+1)^2."""
    k = 1 / temperature
    weights = sampling_weights(TABLE, plain(normalise="quantile", temperature=temperature), "step")
    result = draw_statistics(weights, DRAWN)
    assert result.effective == pytest.approx((2 * k + 1) / (k + 1) ** 2, rel=1e-3)
    assert result.tilt == pytest.approx((k + 1) * 0.99**k, rel=1e-2)
    assert result.largest == pytest.approx(k + 1, rel=1e-2)
    assert result.concentration == pytest.approx(1 - 0.95 ** (k + 1), rel=1e-2)


def test_mixture_with_uniform():
    """(1 - m) w + m has the variance (1 - m)^2 var(w), so 1 / effective share - 1 shrinks by that factor."""
    before, after = (
        effective_size(sampling_weights(TABLE, plain(uniform=m), "step")[DRAWN]) / DRAWN.sum()
        for m in (0.0, 0.3)
    )
    assert 1 / after - 1 == pytest.approx(0.7**2 * (1 / before - 1), rel=1e-6)
    assert (sampling_weights(TABLE, plain(uniform=1.0), "step")[DRAWN] == 1.0).all()


def test_clipping_and_floor():
    table = make_table([[0.0, 0.1, 0.1, 0.8, 1.0]])  # the last step has no action
    np.testing.assert_allclose(
        sampling_weights(table, plain(), "step")[0], np.array([0, 0.1, 0.1, 0.8, 0]) / 0.25
    )
    # 0.8 becomes c = 2 (0 + 0.1 + 0.1 + c) / 4 = 0.2
    clipped = np.array([0.0, 0.1, 0.1, 0.2]) / 0.1
    np.testing.assert_allclose(sampling_weights(table, plain(most=2.0), "step")[0, :4], clipped)
    floored = np.array([0.2, 0.3, 0.3, 1.0]) / 0.45
    np.testing.assert_allclose(sampling_weights(table, plain(floor=0.2), "step")[0, :4], floored)


@pytest.mark.parametrize("most", [1.1, 2.0, 10.0])
def test_clip_bounds_all_weights(most):
    """For several tails; other weights keep their proportions, and as few weights as possible are clipped."""
    rng = np.random.default_rng(0)
    for power in (0.5, 1.0, 4.0):
        score = rng.uniform(0.001, 1.0, (20, 11)) ** power
        table = make_table(score)
        weight = sampling_weights(table, plain(most=most, temperature=0.2), "step")[table.drawable]
        raw = score[table.drawable] ** 5.0
        assert weight.max() == pytest.approx(min(most, raw.max() / raw.mean()))
        below = weight < weight.max() * (1.0 - 1e-9)
        ratio = weight[below] / raw[below]
        np.testing.assert_allclose(ratio, ratio[0])
        assert (weight[~below] <= raw[~below] * ratio[0] * (1.0 + 1e-9)).all()


def test_clip_with_too_few_positive_scores():
    table = make_table([[0.0, 0.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(sampling_weights(table, plain(most=2.0), "step")[0, :4], [0, 0, 0, 8])


@pytest.mark.parametrize(
    ("mean", "deviation", "share"),
    [(0.2835, 0.1712, 0.746), (0.0104, 0.0062, 0.915)],
    ids=["heuristic", "rarity"],
)
def test_published_weights_have_the_published_tilt(mean, deviation, share):
    """Scores with the mean and deviation of the published study, plus 0.01."""
    table = make_table(np.resize((mean - deviation, mean + deviation), (40, 51)))
    weights = sampling_weights(table, PUBLISHED, "step")
    assert effective_size(weights[table.drawable]) / table.drawable.sum() == pytest.approx(share, abs=1e-3)


def test_equal_scores_are_uniform_at_either_scale():
    table = make_table(np.full((3, 9), 0.3))
    for scale in ("step", "scenario"):
        weights = sampling_weights(table, WeightConfig(), scale)
        np.testing.assert_allclose(weights[:, :-1], 1.0)
        assert (weights[:, -1] == 0).all()
        result = draw_statistics(weights, table.drawable)
        assert (result.effective, result.effective_scenarios) == (pytest.approx(1.0), pytest.approx(1.0))


def test_steps_of_a_scenario_share_its_weight():
    valid = np.ones((3, 6), bool)
    valid[1, 4:] = False
    table = make_table(RNG.random((3, 6)), valid, scenarios=[0.1, 0.2, 0.6])
    weights = sampling_weights(table, plain(), "scenario")
    drawn = table.drawable
    assert drawn.sum(axis=1).tolist() == [5, 3, 5]
    mean = (5 * 0.1 + 3 * 0.2 + 5 * 0.6) / 13
    np.testing.assert_allclose(weights, np.where(drawn, np.array([[0.1], [0.2], [0.6]]) / mean, 0.0))


@pytest.mark.parametrize("scale", ["step", "scenario"])
def test_weights_have_mean_one_and_are_zero_without_ego(scale):
    valid = RNG.random((30, 20)) < 0.8
    table = make_table(RNG.random((30, 20)) ** 4, valid)
    weights, drawn = sampling_weights(table, WeightConfig(), scale), table.drawable
    assert weights.shape == valid.shape and weights[drawn].mean() == pytest.approx(1.0)
    assert (weights[~drawn] == 0).all() and (weights[drawn] > 0).all() and not drawn[~valid].any()


def test_low_temperature_is_stable():
    weights = sampling_weights(make_table([[0.1, 0.2, 0.4, 0.4]]), plain(temperature=1e-3), "step")
    np.testing.assert_allclose(weights, [[0.0, 0.0, 3.0, 0.0]], atol=1e-12)


def test_one_step_with_all_the_weight():
    scores = np.zeros((4, 26))
    scores[2, 3] = 1.0
    result = draw_statistics(
        sampling_weights(make_table(scores), plain(), "step"),
        np.pad(np.ones((4, 25), bool), ((0, 0), (0, 1))),
    )
    assert (result.effective, result.effective_scenarios) == (pytest.approx(0.01), pytest.approx(0.25))
    assert (result.largest, result.concentration) == (pytest.approx(100.0), pytest.approx(1.0))


@pytest.mark.parametrize(
    "config", [WeightConfig(), PUBLISHED, plain(temperature=0.3)], ids=["ours", "published", "sharp"]
)
@pytest.mark.parametrize("scale", ["step", "scenario"])
def test_permuted_scores_keep_the_distribution_of_weights(config, scale):
    """The distribution is the same over steps and over scenarios, because scenarios are permuted as a whole."""
    table = make_table(np.clip(RNG.random((500, 1)) ** 3 + 0.1 * RNG.random((500, 41)), 0, 1))
    control = permute_scores(table, seed=7)
    drawn = table.drawable
    own, other = (sampling_weights(scores, config, scale) for scores in (table, control))
    np.testing.assert_allclose(np.sort(own[drawn]), np.sort(other[drawn]))
    own_draws, other_draws = draw_statistics(own, drawn), draw_statistics(other, drawn)
    assert own_draws.effective == pytest.approx(other_draws.effective, rel=1e-9) and own_draws.effective < 0.8
    assert own_draws.effective_scenarios == pytest.approx(other_draws.effective_scenarios, rel=1e-9)
    # Of 500 scenarios: a standard error of 0.045.
    assert abs(np.corrcoef(own[drawn], other[drawn])[0, 1]) < 0.14
    np.testing.assert_array_equal(permute_scores(table, seed=7).steps, control.steps)
    assert not np.array_equal(permute_scores(table, seed=8).steps, control.steps)
    assert control.config["like"] == "made" and not control.components


def test_permuted_scores_are_uniform_over_time():
    late = make_table(np.tile(np.linspace(0.0, 1.0, 41), (2000, 1)))
    control = permute_scores(late, seed=0)
    by_step = control.steps[:, :-1].mean(axis=0)
    # Of 2,000 values that are uniform to 0.975: a standard error of 0.0063.
    np.testing.assert_allclose(by_step, late.steps[0, :-1].mean(), atol=0.03)


def test_permuted_scores_of_scenarios_of_unequal_length():
    valid = np.ones((40, 21), bool)
    valid[::2, 11:] = False
    valid[5] = False
    table = make_table(np.arange(40.0)[:, None] / 40 + np.zeros(21), valid)
    control = permute_scores(table, seed=1)
    drawn = table.drawable
    for row in np.flatnonzero(drawn.any(axis=1)):
        # All scores of a scenario come from the same one.
        assert len({*control.steps[row, drawn[row]], control.scenarios[row]}) == 1
    assert sorted(control.scenarios) == sorted(table.scenarios) and not control.steps[5].any()


def test_weights_are_zero_on_unusable_steps():
    """Ranks, mean and effective size are those of usable steps."""
    usable = DRAWN & (RNG.random(DRAWN.shape) < 0.5)
    weights = sampling_weights(TABLE, plain(normalise="quantile"), "step", usable)
    assert (weights[~usable] == 0).all() and weights[usable].mean() == pytest.approx(1.0)
    order = np.argsort(TABLE.steps[usable])
    count = usable.sum()
    np.testing.assert_allclose(weights[usable][order], (np.arange(count) + 0.5) / count * 2)
    assert draw_statistics(weights, usable).effective == pytest.approx(0.75, rel=1e-3)


@pytest.mark.parametrize("config", [WeightConfig(), plain(most=1.5), PUBLISHED])
def test_scenario_ranks_count_drawable_steps(config):
    """The weights equal those of steps that have the scores of their scenarios."""
    table = make_table(RNG.random((60, 41)), scenarios=RNG.random(60) ** 4)
    usable = table.drawable & (np.arange(41) < RNG.integers(0, 41, 60)[:, None])
    usable[np.argsort(table.scenarios)[-20:]] &= np.arange(41) == 0  # the most critical have one step each
    weights = sampling_weights(table, config, "scenario", usable)
    every = make_table(np.broadcast_to(table.scenarios[:, None], (60, 41)))
    np.testing.assert_allclose(weights, sampling_weights(every, config, "step", usable), rtol=1e-9)
    assert weights.max() < config.most * (1 + 1e-9)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"floor": -0.1}, "floor is -0.1"),
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"most": 1.0}, "most is 1.0"),
        ({"uniform": 1.1}, "uniform is 1.1"),
    ],
)
def test_invalid_arguments_are_refused(settings, words):
    with pytest.raises(UsageError, match=words):
        WeightConfig(**settings)


def test_zero_weights_are_refused():
    with pytest.raises(UsageError, match="every score is 0"):
        sampling_weights(make_table(np.zeros((2, 5))), plain(), "step")
    with pytest.raises(UsageError, match="seed is -1; use 0 or more"):
        permute_scores(make_table(np.ones((2, 5))), -1)
    control = permute_scores(make_table(np.ones((2, 5))), 0)
    with pytest.raises(UsageError, match="scores of 'random_matched' have no components to combine"):
        _ = control.combination
    with pytest.raises(UsageError, match="no step can be drawn"):
        sampling_weights(make_table(np.ones((2, 5)), np.arange(5) % 2 * np.ones((2, 1)) > 0), plain(), "step")

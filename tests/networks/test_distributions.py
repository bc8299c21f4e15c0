"""Distributions against SciPy, numerical integration, finite differences and samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

from drivax.errors import UsageError
from drivax.networks.distributions import (
    Actions,
    Beta,
    Distribution,
    Grid,
    SquashedGaussian,
    SquashedMixture,
    distribution,
    initial_parameters,
    parameter_count,
)
from quick import quick

LEVELS = ((-1.0, -0.25, 0.0, 0.25, 1.0), (-0.5, 0.0, 0.5))
GAUSSIAN = SquashedGaussian(jnp.array([0.3, -1.0]), jnp.array([0.2, 1.4]))
BETA = Beta(jnp.array([1.0, 7.5]), jnp.array([3.0, 2.0]))
GRID = Grid(jnp.asarray(np.random.default_rng(0).normal(size=15), jnp.float32), LEVELS)
MIXTURE = SquashedMixture(
    jnp.array([0.5, -0.3, 0.1]),
    SquashedGaussian(
        jnp.array([[0.3, -1.0], [-0.8, 0.2], [0.0, 1.5]]), jnp.array([[0.2, 1.4], [0.5, 0.3], [0.1, 0.8]])
    ),
)
ALL = {"gaussian": GAUSSIAN, "beta": BETA, "grid": GRID, "mixture": MIXTURE}


def raw_samples(one, count=20_000):
    keys = jax.random.split(jax.random.key(0), count)
    return jnp.asarray(quick(lambda one, keys: jax.vmap(one.sample)(keys), one, keys))


def gaussian_density(action, loc, scale):
    """Density of tanh of a Gaussian: SciPy's density of arctanh, its slope by finite difference in float64."""
    step = 1e-6
    slope = (np.arctanh(action + step) - np.arctanh(action - step)) / (2 * step)
    return stats.norm.pdf(np.arctanh(action), loc, scale) * slope


def test_gaussian_log_prob_and_its_jacobian():
    action = np.array([0.7, -0.99])
    expected = np.log(gaussian_density(action, np.asarray(GAUSSIAN.loc), np.asarray(GAUSSIAN.scale))).sum()
    raw_action = GAUSSIAN.raw_action(jnp.asarray(action))
    assert float(GAUSSIAN.log_prob(raw_action)) == pytest.approx(expected, rel=1e-4)
    np.testing.assert_allclose(GAUSSIAN.action(raw_action), action, atol=1e-5)


def test_gaussian_density_integrates_to_one():
    one = SquashedGaussian(jnp.array([0.4]), jnp.array([0.7]))
    action = np.linspace(-0.9999, 0.9999, 20001)
    log_prob = quick(jax.vmap(one.log_prob), np.arctanh(action)[:, None].astype(np.float32))
    assert np.trapezoid(np.exp(log_prob), action) == pytest.approx(1.0, abs=2e-3)


def test_gaussian_mean_action_equals_quadrature():
    cases = [(loc, scale) for loc in (-3.0, 0.0, 0.8) for scale in (1e-3, 0.3, 2.0)]
    expected = [
        integrate.quad(lambda z, loc=loc, s=s: np.tanh(loc + s * z) * stats.norm.pdf(z), -9, 9)[0]
        for loc, s in cases
    ]
    result = quick(lambda one: one.mean_action(), SquashedGaussian(*jnp.asarray(cases).T))
    np.testing.assert_allclose(result, expected, atol=1e-3)


def test_gaussian_samples_have_its_moments():
    raw_action = raw_samples(GAUSSIAN)
    np.testing.assert_allclose(raw_action.mean(0), GAUSSIAN.loc, atol=0.03)
    np.testing.assert_allclose(raw_action.std(0), GAUSSIAN.scale, atol=0.03)
    np.testing.assert_allclose(GAUSSIAN.mode(), np.median(np.tanh(raw_action), axis=0), atol=0.03)


def test_beta_against_scipy():
    x = np.array([0.2, 0.93])
    reference = stats.beta(np.asarray(BETA.alpha, float), np.asarray(BETA.beta, float), loc=-1, scale=2)
    raw_action = BETA.raw_action(jnp.asarray(2 * x - 1))
    np.testing.assert_allclose(raw_action, x, rtol=1e-6)
    assert float(BETA.log_prob(raw_action)) == pytest.approx(reference.logpdf(2 * x - 1).sum(), rel=1e-5)
    np.testing.assert_allclose(BETA.mean_action(), reference.mean(), rtol=1e-5)
    assert float(BETA.entropy_estimate(jnp.zeros(2))) == pytest.approx(reference.entropy().sum(), rel=1e-4)
    actions = BETA.action(raw_samples(BETA))
    for axis in range(2):
        one = stats.beta(float(BETA.alpha[axis]), float(BETA.beta[axis]), loc=-1, scale=2)
        assert stats.kstest(np.asarray(actions[:, axis]), one.cdf).pvalue > 1e-3
    fine = np.linspace(-0.999, 0.999, 1999)
    np.testing.assert_allclose(BETA.mode(), [-1.0, fine[np.argmax(one.pdf(fine))]], atol=2e-3)


def test_a_uniform_beta_has_its_mode_in_the_middle():
    assert float(Beta(jnp.ones(1), jnp.ones(1)).mode()[0]) == 0.0


def test_grid_against_scipy():
    expected = special.log_softmax(np.asarray(GRID.logits, float))
    table = np.array([(a, b) for a in LEVELS[0] for b in LEVELS[1]])
    raw_action = jnp.arange(15.0)[:, None]
    batch = Grid(jnp.broadcast_to(GRID.logits, (15, 15)), LEVELS)
    np.testing.assert_allclose(batch.log_prob(raw_action), expected, rtol=1e-5)
    np.testing.assert_array_equal(batch.action(raw_action), table.astype(np.float32))
    np.testing.assert_array_equal(batch.raw_action(jnp.asarray(table, jnp.float32) + 0.1), raw_action)
    np.testing.assert_array_equal(GRID.mode(), table[np.argmax(expected)].astype(np.float32))
    np.testing.assert_allclose(GRID.mean_action(), np.exp(expected) @ table, atol=1e-6)
    entropy = float(GRID.entropy_estimate(jnp.zeros(2)))
    assert entropy == pytest.approx(stats.entropy(np.exp(expected)), rel=1e-5)
    counts = np.bincount(np.asarray(raw_samples(GRID)[:, 0], int), minlength=15)
    assert stats.chisquare(counts, np.exp(expected) * counts.sum()).pvalue > 1e-3


def test_mixture_against_scipy():
    action = np.array([[0.7, -0.9], [-0.3, 0.2]])
    shares = special.softmax(np.asarray(MIXTURE.logits, float))
    parts = [
        gaussian_density(action, np.asarray(loc, float), np.asarray(scale, float)).prod(axis=-1)
        for loc, scale in zip(MIXTURE.components.loc, MIXTURE.components.scale, strict=True)
    ]
    log_prob = quick(lambda one, a: jax.vmap(one.log_prob)(one.raw_action(a)), MIXTURE, jnp.asarray(action))
    np.testing.assert_allclose(log_prob, np.log(shares @ np.array(parts)), rtol=1e-4)
    np.testing.assert_allclose(MIXTURE.mode(), np.tanh([0.3, -1.0]), rtol=1e-5)


@pytest.mark.parametrize("kind", ALL)
def test_samples_agree_with_mean_mode_and_entropy(kind):
    one = ALL[kind]
    assert isinstance(one, Distribution)
    raw_action = raw_samples(one)
    noise = jax.random.normal(jax.random.key(1), (len(raw_action), 2))

    def run(one, raw_action, noise):
        estimates = jax.vmap(one.entropy_estimate)(noise)
        return one.action(raw_action), one.mean_action(), jax.vmap(one.log_prob)(raw_action), estimates

    action, mean, log_probs, estimates = quick(run, one, raw_action, noise)
    assert raw_action.dtype == np.float32 and np.abs(action).max() <= 1.0
    np.testing.assert_allclose(action.mean(0), mean, atol=0.02)
    assert estimates.mean() == pytest.approx(-log_probs.mean(), abs=0.04)


@pytest.mark.parametrize("kind", ALL)
def test_gradient_of_the_entropy_reaches_all_parameters(kind):
    """Mean of estimates, and finite differences of the entropy by numerical integration over the actions."""
    actions = Actions(1, ((-1.0, 0.0, 1.0),))
    parameters = jnp.linspace(0.5, -0.4, parameter_count(kind, actions))
    noise = jax.random.normal(jax.random.key(4), (40_000, 1))
    values = jnp.arange(3.0)[:, None] if kind == "grid" else jnp.linspace(-0.9999, 0.9999, 20_001)[:, None]
    width = 1.0 if kind == "grid" else values[1, 0] - values[0, 0]

    def estimate(parameters, noise):
        return distribution(kind, parameters, actions).entropy_estimate(noise)

    def integral(parameters):
        one = distribution(kind, parameters, actions)
        raw_actions = {"grid": values, "beta": (values + 1) / 2}.get(kind, jnp.arctanh(values))
        log_prob = jax.vmap(one.log_prob)(raw_actions)
        return -jnp.sum(jnp.exp(log_prob) * log_prob) * width

    result = quick(jax.vmap(jax.grad(estimate), (None, 0)), parameters, noise).mean(0)
    steps = 0.02 * np.eye(len(parameters), dtype=np.float32)
    differences = quick(
        jax.vmap(lambda step: integral(parameters + step) - integral(parameters - step)), steps
    )
    np.testing.assert_allclose(result, differences / 0.04, atol=0.02)
    assert np.abs(differences).max() > 0.002


@pytest.mark.parametrize("kind", ["gaussian", "beta"])
def test_samples_are_differentiable_in_the_parameters(kind):
    """d E[action^2] / d parameters, through samples and by finite differences of SciPy's moments."""
    raw = jnp.array([0.7, 0.4])

    def second(raw, key):
        one = distribution(kind, raw, Actions(1))
        return one.action(one.sample(key))[0] ** 2

    keys = jax.random.split(jax.random.key(3), 40_000)
    result = quick(jax.vmap(jax.grad(second), (None, 0)), raw, keys).mean(0)

    def moment(raw):
        if kind == "beta":
            one = stats.beta(*(1.0 + np.log1p(np.exp(raw))), loc=-1, scale=2)
            return one.var() + one.mean() ** 2
        scale = np.log1p(np.exp(raw[1]))
        grid = raw[0] + scale * np.linspace(-9, 9, 4001)
        return np.trapezoid(np.tanh(grid) ** 2 * stats.norm.pdf(grid, raw[0], scale), grid)

    raw = np.asarray(raw, float)
    expected = [(moment(raw + step) - moment(raw - step)) / 2e-4 for step in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(result, expected, atol=0.01)


@pytest.mark.parametrize("kind", ALL)
def test_policy_gradients_are_finite_at_saturation(kind):
    actions = Actions(2, LEVELS)
    count = parameter_count(kind, actions)
    raw = jnp.array([0.0, 30.0, -30.0])[:, None] * jnp.sign(jnp.arange(count) % 2 - 0.5)
    bounds = jnp.array([[1.0, -1.0], [-1.0, 1.0], [0.0, 0.0]])

    def of(raw, key):
        one = distribution(kind, raw[:, None].repeat(3, 1), actions)
        raw_action = one.raw_action(jnp.broadcast_to(bounds, (3, 3, 2)))
        far = raw_action + (9.0 if kind in ("gaussian", "mixture") else 0.0)
        mine = one.sample(key)
        surrogate = (
            one.log_prob(raw_action)
            + one.log_prob(far)
            + one.log_prob(mine)
            + one.entropy_estimate(jax.random.normal(key, (3, 3, 2)))
        )
        return jnp.sum(surrogate) + jnp.sum(one.mean_action() + one.mode() + one.action(mine))

    value, gradient = quick(jax.value_and_grad(of), raw, jax.random.key(0))
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_first_parameters_are_centred_with_the_requested_scale():
    actions = Actions(2, LEVELS)
    gaussian = distribution("gaussian", jnp.asarray(initial_parameters("gaussian", actions, 0.3)), actions)
    np.testing.assert_allclose(gaussian.scale, 0.3, rtol=1e-5)
    beta = distribution("beta", jnp.asarray(initial_parameters("beta", actions, 0.3)), actions)
    np.testing.assert_allclose(beta.action(raw_samples(beta)).std(0), 0.3, rtol=0.02)
    grid = distribution("grid", jnp.asarray(initial_parameters("grid", actions, 0.3)), actions)
    weights = [stats.norm.pdf(np.array(axis), 0, 0.3) for axis in LEVELS]
    np.testing.assert_allclose(
        jax.nn.softmax(grid.logits), np.outer(*(w / w.sum() for w in weights)).ravel(), atol=1e-6
    )
    mixture = distribution("mixture", jnp.asarray(initial_parameters("mixture", actions, 0.3)), actions)
    np.testing.assert_allclose(mixture.components.scale, 0.3, rtol=1e-5)
    assert parameter_count("mixture", actions) == len(initial_parameters("mixture", actions, 0.3))
    for one in (gaussian, beta, grid, mixture):
        np.testing.assert_allclose(one.mean_action(), 0.0, atol=1e-6)
        np.testing.assert_allclose(one.mode(), 0.0, atol=1e-6)


def test_mistakes_are_named():
    with pytest.raises(UsageError, match="the grid needs actions with levels; choose the action space"):
        parameter_count("grid", Actions(2))
    with pytest.raises(UsageError, match=r"a Beta of first_scale 0\.6 has no peak; use less"):
        initial_parameters("beta", Actions(2), 0.6)
    for kind, scale in (("gaussian", 3.0), ("mixture", (0.3, 1e-4))):
        with pytest.raises(UsageError, match=rf"first_scale of a {kind} is .*; use 0.001 to 2"):
            initial_parameters(kind, Actions(2), scale)
    with pytest.raises(UsageError, match="levels of 1 numbers for actions of 2"):
        Actions(2, ((0.0,),))

"""Convert scores to sampling weights, compute statistics of weighted draws, and permute scores as a control."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.scores import ScoreTable
from drivax.errors import UsageError
from drivax.stats.intervals import effective_size

Scale = Literal["step", "scenario"]
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class WeightConfig:
    """Settings that convert scores to sampling weights, over all drawable steps of a set.

    For the score s of a step, or of its scenario:

    1. ``quantile``: u is the mid-rank of s among all n steps, divided by n. Equal scores have equal weights, and only
       the order of the scores matters. ``none``: u = s. Then u + ``floor``.
    2. w = u ** (1 / ``temperature``): 1 keeps the ratios, higher temperatures flatten the weights, lower ones sharpen
       them.
    3. w is clipped to ``most`` times the mean of the clipped weights, and divided by that mean. If fewer than
       n / ``most`` weights are above 0, these become equal.
    4. ``(1 - uniform) w + uniform``: a mixture with uniform sampling, with mean 1.

    Attributes:
        normalise: See 1.
        floor: See 1.
        temperature: See 2.
        most: See 3.
        uniform: See 4.
    """

    normalise: Literal["quantile", "none"] = "quantile"
    floor: float = 0.0
    temperature: float = 0.5
    most: float = 10.0
    uniform: float = 0.2

    def __post_init__(self) -> None:
        for name, is_valid, cure in (
            ("floor", 0.0 <= self.floor < float("inf"), "use 0 or more, but not inf"),
            ("temperature", 0.0 < self.temperature < float("inf"), "use a positive number, but not inf"),
            ("most", self.most > 1.0, "use more than 1, inf for no limit"),
            ("uniform", 0.0 <= self.uniform <= 1.0, "use 0 to 1"),
        ):
            if not is_valid:
                raise UsageError(f"{name} is {getattr(self, name)}", cure=cure)


#: Weights of the published study, proportional to the score plus 0.01.
PUBLISHED = WeightConfig(normalise="none", floor=0.01, temperature=1.0, most=float("inf"), uniform=0.0)


def sampling_weights(
    table: ScoreTable, config: WeightConfig, scale: Scale, usable: Bool[Array, "L T"] | None = None
) -> Float[Array, "M T"]:
    """Return the weight of every step of the logs in a table: mean 1 over drawable steps, 0 elsewhere.

    At the scale ``scenario``, all steps of a scenario have the same weight. Drawable steps are ``usable``
    (:func:`drivax.learning.loop.usable_steps`), by default ``ScoreTable.drawable``. If training drives all egos and the
    table has only the recorded ones, a step is drawable if any ego of its scenario can use it.

    Raises:
        UsageError: No step is drawable, all weights are 0, or the table has egos that training does not drive.
    """
    drawable = _drawable_steps(table, usable)
    if not drawable.any():
        raise UsageError("no step can be drawn", cure="check the set")
    weights = np.zeros(drawable.shape)
    if scale == "step":
        weights[drawable] = _score_weights(table.steps[drawable], np.ones(int(drawable.sum())), config)
    else:
        mass = drawable.reshape(len(table.scenarios), -1).sum(axis=1)
        scenario_weights = np.zeros(len(mass))
        scenario_weights[mass > 0] = _score_weights(
            table.scenarios[mass > 0], mass[mass > 0].astype(np.float64), config
        )
        weights = np.where(drawable, np.repeat(scenario_weights, table.egos)[:, None], 0.0)
    if not weights.any():
        raise UsageError("every score is 0, so all weights are 0", cure="set floor, or normalise: quantile")
    return weights / weights[drawable].mean()


def _drawable_steps(table: ScoreTable, usable: Bool[Array, "L T"] | None) -> Bool[Array, "M T"]:
    """Return the mask of drawable steps of the logs in a table."""
    if usable is None or len(usable) == len(table.steps):
        return table.drawable if usable is None else usable
    if table.egos > 1:
        cure = "train with --egos moving, or score with --egos recorded"
        raise UsageError(
            f"scores of {table.egos} egos per scenario, training drives the recorded one", cure=cure
        )
    return np.asarray(usable.reshape(len(table.steps), -1, usable.shape[1]).any(axis=1))


def _score_weights(
    scores: Float[Array, " n"], mass: Float[Array, " n"], config: WeightConfig
) -> Float[Array, " n"]:
    """Return the weight of each score, with mean 1 over steps; ``mass`` is the number of steps of each score."""
    score = np.asarray(scores, np.float64)
    if config.normalise == "quantile":
        _, rank = np.unique(score, return_inverse=True)
        mass_by_rank = np.bincount(rank, mass)
        score = ((np.cumsum(mass_by_rank) - mass_by_rank / 2.0) / mass.sum())[rank]
    # Logarithms avoid overflow and underflow at low temperatures.
    with np.errstate(divide="ignore"):
        log_weight = np.log(score + config.floor) / config.temperature
    if not np.isfinite(log_weight.max()):
        return np.zeros(len(score))
    weight = _clip(np.exp(log_weight - log_weight.max()), mass, config.most)
    return (1.0 - config.uniform) * weight / np.average(weight, weights=mass) + config.uniform


def _clip(weight: Float[Array, " n"], mass: Float[Array, " n"], most: float) -> Float[Array, " n"]:
    """Clip the largest weights to ``most`` times the mean of the result."""
    order = np.argsort(-weight, kind="stable")
    sorted_weight, sorted_mass = weight[order], mass[order]
    if sorted_weight[0] <= most * np.average(weight, weights=mass):
        return weight
    # Clipping the k largest weights (mass m) to c gives c = most (m c + tail) / n; tail is the sum of the others.
    clipped_mass = np.cumsum(sorted_mass) - sorted_mass
    tail_sum = np.cumsum((sorted_weight * sorted_mass)[::-1])[::-1]
    remaining = mass.sum() - most * clipped_mass
    limit = most * tail_sum / np.where(remaining > 0.0, remaining, np.inf)
    feasible = np.flatnonzero((remaining > 0.0) & (limit >= sorted_weight) & (limit > 0.0))
    return np.minimum(weight, limit[feasible[0]] if len(feasible) else sorted_weight[sorted_weight > 0].min())


@dataclass(frozen=True)
class DrawStatistics:
    """Statistics of weighted draws.

    Attributes:
        effective: Effective sample size over the number of drawable steps, ``(sum w)^2 / (n sum w^2)`` (Kish, 1965):
            1 for uniform weights, 1 / n if one step has all the weight.
        effective_scenarios: The same for the sums of weights of scenarios.
        tilt, largest: 99th percentile and maximum of the weights, over their mean.
        concentration: Share of the draws from the 5 % of steps (at least one) with the largest weights; 0.05 for many
            steps of uniform weights.
    """

    effective: float
    effective_scenarios: float
    tilt: float
    largest: float
    concentration: float


def draw_statistics(
    weights: Float[Array, "M T"], drawable: Bool[Array, "M T"], egos: int = 1
) -> DrawStatistics:
    """Return statistics of weights over drawable steps; each scenario has ``egos`` consecutive logs."""
    values = weights[drawable]
    scenario_sums = weights.sum(axis=1).reshape(-1, egos).sum(axis=1)
    has_steps = drawable.any(axis=1).reshape(-1, egos).any(axis=1)
    sorted_values = np.sort(values)[::-1]
    return DrawStatistics(
        effective=effective_size(values) / values.size,
        effective_scenarios=effective_size(scenario_sums[has_steps]) / int(has_steps.sum()),
        tilt=float(np.quantile(values, 0.99) / values.mean()),
        largest=float(sorted_values[0] / values.mean()),
        concentration=float(sorted_values[: max(round(len(values) * 0.05), 1)].sum() / values.sum()),
    )


def permute_scores(table: ScoreTable, seed: int, usable: Bool[Array, "L T"] | None = None) -> ScoreTable:
    """Return the matched random control of a table: each scenario gets the shifted scores of a random scenario.

    Shifts are cyclic. This keeps the distribution of scores over steps, within scenarios, and among scenarios;
    exactly, if all scenarios have the same number of usable steps (longer sequences are cut, shorter ones repeated).
    Permuting single steps would spread large scores over all scenarios, so that the control would sample more
    scenarios. The logs of a scenario's egos form one sequence. ``usable`` is as in :func:`sampling_weights`; all other
    steps keep their scores.

    Raises:
        UsageError: ``seed`` is negative.
    """
    if seed < 0:
        raise UsageError(f"seed is {seed}", cure="use 0 or more")
    rng = np.random.default_rng(seed)
    shape = (len(table.scenarios), -1)
    drawable = _drawable_steps(table, usable).reshape(shape)
    original, scenarios = table.steps.reshape(shape), table.scenarios.copy()
    steps = original.copy()
    indices = np.flatnonzero(drawable.any(axis=1))
    for index, source in zip(indices, rng.permutation(indices), strict=True):
        scores = original[source, drawable[source]]
        scores = np.roll(scores, rng.integers(len(scores)))
        steps[index, drawable[index]] = np.resize(scores, int(drawable[index].sum()))
        scenarios[index] = table.scenarios[source]
    config = {"like": table.method, "like_config": dict(table.config), "seed": seed}
    table = replace(table, method="random_matched", config=config, components={})
    return replace(table, steps=steps.reshape(table.steps.shape), scenarios=scenarios)

"""Conditions: numbers of the reward that differ between agents and episodes, and that the policy observes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.errors import UsageError, did_you_mean
from drivax.scenario.bank.scenario_bank import Scalar
from drivax.tasks.rewards import OPTIONS, TERMS, RewardConfig

#: Separates the draws of conditions from those of starts, which split the same key.
_STREAM = 0x636F6E64
#: Bounds of the options that a condition may replace. The collision margin is not one: it decides which facts are read.
_OPTIONS = {name: bound for name, bound in OPTIONS.items() if name != "collision_margin_m"}


@dataclass(frozen=True)
class Condition:
    """A factor of a reward term's weight, or an option of the reward, drawn for each agent and episode of training.

    Draws are uniform. Evaluation, validation, logged steps, policy-driven traffic and the Gymnasium adapter use
    ``value``.

    Attributes:
        name: A term of the reward, built-in or the user's; or an option: ``desired_speed``, ``time_gap_s``, ``ttc_s``
            or ``close_m``.
        low, high: Range of the draws.
        value: Value in evaluation.
        fixed: Whether training uses ``value`` too.
    """

    name: str
    low: float
    high: float
    value: float = 1.0
    fixed: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.low < self.high < math.inf:
            problem = f"condition {self.name} from {self.low} to {self.high}"
            raise UsageError(problem, cure="use 0 <= low < high")
        if not self.low <= self.value <= self.high:
            problem = f"condition {self.name}: value {self.value} is not in {self.low} to {self.high}"
            raise UsageError(problem, cure="set a value in the range")


#: Conditions of a task; columns of the observation group ``conditions`` are in this order.
Conditions = tuple[Condition, ...]


def check_conditions(conditions: Conditions, rewards: RewardConfig) -> None:
    """Check the conditions.

    Raises:
        UsageError: A condition has no effect on the reward, is beyond the bound of its option, or occurs twice.
    """
    weights, names = rewards.weights(), [condition.name for condition in conditions]
    active = [term.option for name, term in TERMS.items() if name in weights]
    options = {name: bound for name, bound in _OPTIONS.items() if name in active}
    for condition in conditions:
        name = condition.name
        if name not in options and name not in weights:
            options_of = {key: term.option for key, term in TERMS.items() if term.option in _OPTIONS}
            terms = [key for key in TERMS if name in (key, options_of.get(key))]
            cure = f"give {terms[0]} a weight" if terms else did_you_mean(name, [*weights, *options])
            raise UsageError(f"condition {name}: not in the reward", cure=cure)
        if condition.high > options.get(name, math.inf):
            problem = f"condition {name}: high is {condition.high}"
            raise UsageError(problem, cure=f"use at most {options[name]:g}")
        if names.count(name) > 1:
            raise UsageError(f"condition {name} occurs twice", cure="name it once")


def draw_conditions(conditions: Conditions, slot: Any, key: Any) -> tuple[()] | Float[Array, " C"]:
    """Return random values for an agent's episode, or those of evaluation if ``key`` is None; () without conditions."""
    if not conditions:
        return ()
    values = jnp.array([condition.value for condition in conditions], jnp.float32)
    if key is None:
        return values
    low, high = _ranges(conditions)
    key = jax.random.fold_in(jax.random.fold_in(key, _STREAM), slot)
    draws = jax.random.uniform(key, values.shape, minval=low, maxval=high)
    return jnp.where(jnp.array([condition.fixed for condition in conditions]), values, draws)


def scale_conditions(conditions: Conditions, values: Float[Array, " C"]) -> Float[Array, " C"]:
    """Scale values to [-1, 1] by their ranges."""
    low, high = _ranges(conditions)
    return (2.0 * values - low - high) / (high - low)


def _ranges(conditions: Conditions) -> Float[Array, "2 C"]:
    """Return the lower and upper bounds of the draws."""
    return jnp.array([(c.low, c.high) for c in conditions], jnp.float32).T


def by_name(conditions: Conditions, values: Any) -> dict[str, Scalar]:
    """Return the values by name."""
    return {condition.name: values[column] for column, condition in enumerate(conditions)}


def fix_conditions(conditions: Conditions, values: Mapping[str, float] | None = None) -> Conditions:
    """Return the conditions fixed at ``values`` by name, or else at their own value.

    Raises:
        UsageError: A value is out of range, or its name is unknown.
    """
    values = values or {}
    names = [condition.name for condition in conditions]
    for name in values:
        if name not in names:
            cure = did_you_mean(name, names) if names else "this planner has no conditions"
            raise UsageError(f"unknown condition {name!r}", cure=cure)
    return tuple(replace(c, value=values.get(c.name, c.value), fixed=True) for c in conditions)


def parse_values(assignments: Sequence[str]) -> dict[str, float]:
    """Parse ``NAME=NUMBER`` arguments.

    Raises:
        UsageError: An argument has another form, or a name occurs twice.
    """
    values: dict[str, float] = {}
    for assignment in assignments:
        name, _, number = assignment.partition("=")
        if name in values:
            raise UsageError(f"condition {name} occurs twice", cure="name it once")
        try:
            values[name] = float(number)
        except ValueError as error:
            raise UsageError(f"condition {assignment!r} has no number", cure="write NAME=NUMBER") from error
    return values

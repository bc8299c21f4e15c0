"""An algorithm that compiles at once: it learns random numbers, and drives at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from drivax.planners.simple import ConstantVelocity
from drivax.scenario.record import record

#: Settings of a training of six iterations.
VALUES = {
    "algorithm": {"kind": "toy_learner:ToyConfig"},
    "task": {"observation": {"agents": 1, "steps": 1, "road": 0, "lights": 1, "route": 2}},
    "seed": 4,
    "total_steps": 60,
    "checkpoint_every": 2,
}


@record
class ToyState:
    parameters: Any
    key: Any
    iteration: Any
    seed: Any


@dataclass(frozen=True)
class ToyConfig:
    """Ten steps an iteration.

    ``nan_at`` is an iteration from which on ``nan_in`` (``parameters``, ``loss`` or ``reward``) is NaN; 0: never. It
    affects only the seed ``nan_seed``, or with -1 all.
    """

    size: int = 3
    nan_at: int = 0
    nan_in: str = "parameters"
    nan_seed: int = -1
    kl: float = 0.0

    @property
    def steps_per_iteration(self):
        return 10

    def build(self, environment, data, iterations):
        return Toy(self)


class Toy:
    def __init__(self, config):
        self.config = config

    def init(self, data, key):
        seed = jax.random.key_data(key)[-1].astype(jnp.int32)
        return ToyState(jnp.zeros(self.config.size), key, jnp.zeros((), jnp.int32), seed)

    def iterate(self, data, state):
        config, iteration = self.config, state.iteration + 1
        key, use = jax.random.split(state.key)
        parameters = state.parameters + jax.random.normal(use, state.parameters.shape)
        fails = (config.nan_at > 0) & (iteration >= config.nan_at)
        fails &= (config.nan_seed < 0) | (state.seed == config.nan_seed)
        nan = {name: jnp.where(fails & (config.nan_in == name), jnp.nan, 0.0) for name in ("loss", "reward")}
        logs = {
            "loss/toy": parameters.sum() + nan["loss"],
            "loss/sum": 2 * parameters[0],
            "loss/sum/n": jnp.asarray(2.0),
            "loss/kl": jnp.asarray(config.kl),
            "rollout/reward/hurry": nan["reward"],
            "rollout/steps": jnp.asarray(10.0),
        }
        if config.nan_in == "parameters":
            parameters = parameters.at[-1].add(jnp.where(fails, jnp.nan, 0.0))
        return ToyState(parameters, key, iteration, state.seed), logs

    def planner(self, parameters, name, samples):
        return ConstantVelocity()

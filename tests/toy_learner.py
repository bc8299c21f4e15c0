"""An algorithm that compiles at once: it learns random numbers, and drives at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from drivax.planners.simple import ConstantVelocity
from drivax.scenario.record import record


@record
class ToyState:
    parameters: Any
    key: Any
    iteration: Any


@dataclass(frozen=True)
class ToyConfig:
    """Ten steps an iteration."""

    size: int = 3

    @property
    def steps_per_iteration(self):
        return 10

    def build(self, environment, data, iterations):
        return Toy(self)


class Toy:
    def __init__(self, config):
        self.config = config

    def init(self, data, key):
        return ToyState(jnp.zeros(self.config.size), key, jnp.zeros((), jnp.int32))

    def iterate(self, data, state):
        key, use = jax.random.split(state.key)
        parameters = state.parameters + jax.random.normal(use, state.parameters.shape)
        logs = {"loss/toy": parameters.sum(), "loss/sum": 2 * parameters[0], "loss/sum/n": jnp.asarray(2.0)}
        return ToyState(parameters, key, state.iteration + 1), logs

    def planner(self, parameters, name, samples):
        return ConstantVelocity()

"""Check of algorithms: a custom algorithm and PPO pass, and each rule has an algorithm that violates it."""

import re
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import own_terms
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.planners.simple import ConstantVelocity, RandomActions
from drivax.scenario.record import record
from drivax.testing import BrokenContract, check_algorithm


@record
class State:
    """State of the toy algorithm."""

    parameters: jax.Array
    iteration: jax.Array
    key: jax.Array


@dataclass(frozen=True)
class Toy:
    """An algorithm that ignores driving, with a fault."""

    fault: str = ""

    @property
    def steps_per_iteration(self):
        return 0 if self.fault == "steps" else 5

    def build(self, environment, data, iterations):
        return object() if self.fault == "learner" else ToyLearner(self.fault)


class ToyLearner:
    def __init__(self, fault):
        self.fault = fault

    def init(self, bank, key):
        if self.fault == "state":
            return {"parameters": jnp.zeros(2)}
        return State(jnp.zeros(2), jnp.zeros((), jnp.int32), key)

    def iterate(self, bank, state):
        key, use = jax.random.split(state.key)
        step = jax.random.normal(use, (2,))
        if self.fault == "host":
            step = jax.pure_callback(lambda: np.random.default_rng().normal(size=2).astype(np.float32), step)
        parameters = state.parameters + (0.0 if self.fault == "idle" else step)
        if self.fault == "form":
            parameters = jnp.append(parameters, 1.0)
        if self.fault == "nan":
            parameters = parameters * jnp.nan
        iteration = state.iteration + (2 if self.fault == "count" else 1)
        loss = {"vector": step, "infinite": jnp.inf}.get(self.fault, jnp.sum(step))
        return State(parameters, iteration, key), {"loss/toy": jnp.asarray(loss)}

    def planner(self, parameters, name, samples):
        if self.fault == "driver":
            return lambda observation: parameters
        return RandomActions() if samples or self.fault == "mode" else ConstantVelocity()


@pytest.mark.parametrize(
    ("fault", "words"),
    {
        "steps": "counts 0 steps per iteration", "learner": "builds no Learner",
        "state": "without parameters or iteration", "form": "changes the shape of its state", "idle": "learns nothing",
        "count": "from iteration 0 to 2", "host": "does not repeat an iteration", "nan": "is not finite",
        "vector": "logs 'loss/toy' as", "infinite": "logs 'loss/toy' as inf", "driver": "returns no Planner",
        "mode": "uses randomness in its mode",
    }.items(),
)  # fmt: skip
def test_invalid_algorithms_fail(fault, words):
    with pytest.raises(BrokenContract) as error:
        check_algorithm(Toy(fault))
    assert re.search(words, str(error.value)) and "\n" not in str(error.value)


def test_toy_algorithm_passes():
    check_algorithm(Toy())


@pytest.mark.slow
def test_custom_algorithm_passes():
    check_algorithm("own_terms:ReinforceConfig")


@pytest.mark.slow
def test_ppo_passes_the_check_of_algorithms():
    network = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,))
    check_algorithm(PpoConfig(network=network, environments=4, unroll=4, epochs=1, minibatches=2))
    with_own = replace(network, encoder=own_terms.MeanConfig())
    check_algorithm(PpoConfig(network=with_own, environments=4, unroll=4, epochs=1, minibatches=2))


def test_custom_algorithm_is_short(repository):
    """The algorithm of the guide takes at most 80 lines."""
    guide = (repository / "docs" / "guide" / "custom.md").read_text()
    (code,) = re.findall(r"```python\n(# my_algorithm.py\n.*?)```", guide, re.S)
    assert "class ReinforceConfig" in code and len(code.splitlines()) <= 80

"""Valid extensions as a user writes them, referenced by dotted name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from drivax.curation.scores import Combination
from drivax.learning.environment import collect
from drivax.metrics.catalogue import Metric
from drivax.metrics.steps import StepValue
from drivax.networks.encoders import group_names
from drivax.planners.functions import NetworkPlanner
from drivax.planners.planner import Memoryless
from drivax.scenario.record import record
from drivax.tasks.observations import View


def hurry(before, now, around):
    """Shortfall of the speed from 10 m/s, as a share."""
    return jnp.clip(1.0 - now.speed_mps / 10.0, 0.0, 1.0)


@dataclass(frozen=True)
class Crowded:
    """Number of other agents within a distance, over ten."""

    within_m: float = 20.0

    def __call__(self, before, now, around):
        frame = around.frame
        offset = frame.box[1:, :2] - frame.box[0, :2]
        near = frame.valid[1:] & (jnp.sum(offset * offset, axis=-1) < self.within_m**2)
        return near.sum().astype(jnp.float32) / 10.0


def goal(bank, context, frames):
    """The goal in the ego frame, in units of 50 m, clipped to 5."""
    return jnp.clip(View.of(context).point(bank.goal[context.row])[None] / 50.0, -5.0, 5.0)


def walkers(bank, context, frames):
    """Position and velocity of the three nearest pedestrians."""
    now, view = frames(0), View.of(context)
    place = view.point(now.box[:, :2])
    there = now.valid & (now.kind == 2) & (jnp.linalg.norm(place, axis=-1) < 60.0)
    distance = jnp.where(there, jnp.sum(place * place, axis=-1), jnp.inf)
    chosen = jnp.argsort(distance)[:3]
    rows = jnp.concatenate([place / 50.0, view.vector(now.velocity) / 15.0], axis=-1)
    return rows[chosen], there[chosen]


def _gap(moment):
    frame = moment.situation.surroundings.frame
    offset = frame.box[1:, :2] - frame.box[0, :2]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset * offset, axis=-1), 1e-6))
    return jnp.min(jnp.where(frame.valid[1:], distance, 1e3)), frame.valid[1:].any()


nearest_other = Metric(
    unit="m",
    better="high",
    definition="smallest distance between centres",
    step_value=StepValue("nearest_other", "m", _gap, frozenset()),
    operator="min",
)
crashed = nearest_other
lane_changes = Metric(
    unit="-",
    better="-",
    definition="lane changes",
    step_value=StepValue(
        "lane_changed",
        "-",
        lambda m: (m.facts.lane_changed.astype(jnp.float32), True),
        frozenset({"lane_changed"}),
    ),
    operator="sum",
)


class _Mean(nnx.Module):
    def __init__(self, config, spec, rngs):
        self.names = group_names(spec)
        self.width = config.width
        self.layers = nnx.Dict({n: nnx.Linear(spec[n][-1], config.width, rngs=rngs) for n in self.names})
        self.ranks = {n: len(spec[n]) for n in self.names}

    def __call__(self, groups):
        total = 0.0
        for name in self.names:
            value = groups[name]
            mask = groups.get(f"{name}_mask", jnp.ones(value.shape[:-1], bool))[..., None]
            rows = jnp.where(mask, jnp.tanh(self.layers[name](jnp.where(mask, value, 0.0))), 0.0)
            axes = tuple(range(-self.ranks[name], -1))
            total += rows.sum(axes) / jnp.maximum(mask.sum(axes), 1)
        return total


@dataclass(frozen=True)
class MeanConfig:
    """One layer per group, applied to every row, then the mean."""

    width: int = 8

    def build(self, spec, rngs):
        return _Mean(self, spec, rngs)


@record
class ReinforceState:
    """Training state of REINFORCE."""

    parameters: Any
    optimiser: Any
    environments: Any
    key: Any
    iteration: Any


class _Gauss(nnx.Module):
    def __init__(self, spec, rngs):
        self.encoder = MeanConfig().build(spec, rngs)
        self.mean = nnx.Linear(8, 2, rngs=rngs)

    def __call__(self, groups):
        return _Action(self.mean(self.encoder(groups)))


@record
class _Action:
    loc: Any

    def sample(self, key):
        return self.loc + 0.3 * jax.random.normal(key, self.loc.shape)

    def action(self, raw_action):
        return jnp.tanh(raw_action)

    def mode(self):
        return self.action(self.loc)


class Reinforce:
    """REINFORCE with the reward-to-go of the next steps."""

    def __init__(self, config, environment, data):
        self.config, self.environment = config, environment
        self.spec = environment.shapes(data)
        self.graph, _ = nnx.split(_Gauss(self.spec, nnx.Rngs(0)))
        self.optimiser = optax.adam(config.learning_rate)

    def init(self, data, key):
        key, network, starting = jax.random.split(key, 3)
        parameters = nnx.state(_Gauss(self.spec, nnx.Rngs(network)), nnx.Param)
        environments = self.environment.start(data, starting, self.config.environments)
        return ReinforceState(
            parameters, self.optimiser.init(parameters), environments, key, jnp.zeros((), jnp.int32)
        )

    def iterate(self, data, state):
        key, collecting = jax.random.split(state.key)
        policy = nnx.merge(self.graph, state.parameters)

        def actor(seen, key):
            raw_action = policy(seen).sample(key)
            return raw_action, jnp.tanh(raw_action), {}

        environments, rollout, sums = collect(
            self.environment, data, state.environments, actor, collecting, self.config.unroll
        )
        gains = jnp.cumsum(rollout.reward[::-1], axis=0)[::-1]

        def loss(parameters):
            policy = nnx.merge(self.graph, parameters)
            error = (rollout.raw_action - policy(rollout.observation).loc) / 0.3
            log_prob = -0.5 * jnp.sum(error * error, axis=-1)
            return -jnp.mean(rollout.alive * (gains - gains.mean()) * log_prob)

        value, gradient = jax.value_and_grad(loss)(state.parameters)
        change, optimiser = self.optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, change)
        logs = {f"rollout/{name}": total for name, total in sums.items()} | {"loss/policy": value}
        return ReinforceState(parameters, optimiser, environments, key, state.iteration + 1), logs

    def planner(self, parameters, name, samples):
        return NetworkPlanner(parameters, self.graph, name, samples)


@dataclass(frozen=True)
class ReinforceConfig:
    """REINFORCE."""

    environments: int = 3
    unroll: int = 4
    learning_rate: float = 1e-2

    @property
    def steps_per_iteration(self):
        return self.environments * self.unroll

    def build(self, environment, data, iterations):
        return Reinforce(self, environment, data)


@dataclass(frozen=True)
class Drift:
    """Traffic in which all agents keep the velocity that they have at the start."""

    name: str = "drift"

    def start(self, bank, index, step):
        return bank.agents[index, step]

    def advance(self, bank, context, frame):
        rows = context.traffic
        return rows.at[:, :2].add(0.1 * rows[:, 5:7])

    def agents(self, bank, context, back):
        rows = context.traffic
        return rows.at[:, :2].add(-0.1 * back * rows[:, 5:7])


@dataclass(frozen=True)
class FullBrake(Memoryless):
    """Brake fully."""

    name: str = "full_brake"
    replays: bool = False

    def act(self, carry, bank, state, situation, observation, key):
        return jnp.array([-1.0, 0.0]), carry


jax.tree_util.register_static(FullBrake)


def proximity(bank, log):
    """A criticality method without settings or weights: how close the nearest other agent is, within 20 m."""
    box = log.frame.box
    offset = box[:, :, :2] - box[:, log.slot, None, :2]
    other = log.frame.valid & (jnp.arange(box.shape[1]) != log.slot)
    distance = jnp.where(other, jnp.sqrt(jnp.sum(offset * offset, axis=-1) + 1e-6), jnp.inf).min(axis=1)
    return {"near": jnp.clip(1.0 - distance / 20.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Speeds:
    """A criticality method with a setting and a combination."""

    full_mps: float = 20.0
    combination = Combination({"speed": 2.0, "standing": 1.0}, "mean")

    def __call__(self, bank, log):
        speed = log.motion[:, 3]
        return {
            "speed": jnp.clip(speed / self.full_mps, 0.0, 1.0),
            "standing": (speed < 0.5).astype(jnp.float32),
        }


def outside(bank, log):
    """Not a criticality method: above 1, and dependent on the order of agents."""
    return {"first": log.frame.box[:, 1, 0]}

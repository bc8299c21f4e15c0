"""Base of off-policy algorithms, online (SAC) and offline (CQL, IQL, ...): policy, twin critics, and one update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.learning.environment import Environment
from drivax.learning.program import is_largest
from drivax.learning.replay import Transitions
from drivax.networks.actor_critic import NetworkConfig, Policy, TwinCritic, graph_of
from drivax.networks.distributions import Actions, Distribution
from drivax.planners.functions import NetworkPlanner
from drivax.rl.equations import polyak, soft_policy_loss, td_target, temperature_loss


@runtime_checkable
class OffPolicyConfig(Protocol):
    """Settings that off-policy algorithms share."""

    @property
    def network(self) -> NetworkConfig:
        """Architecture of policy and critics."""
        ...

    @property
    def gamma(self) -> float:
        """Discount."""
        ...

    @property
    def tau(self) -> float:
        """Polyak averaging rate of target networks."""
        ...


Config = TypeVar("Config", bound=OffPolicyConfig)
#: Trained networks and scalars, by name (``trained["policy"]``).
Trained = Any
#: Trained parameters, target networks by name, and the optimiser's state.
Carry = tuple[Trained, dict[str, Any], Any]


class SoftActor(NamedTuple):
    """Losses of a soft actor, with the policy and Q values that they use."""

    policy: Distribution
    q_values: Float[Array, "2 B"]
    loss: Float[Array, " B"]
    temperature_loss: Float[Array, ""]
    logs: dict[str, Array]


def q_logs(q: Array) -> dict[str, Array]:
    """Return values to log of the Q values of the data's actions: their mean, and the largest absolute one."""
    return {"mean_q": jnp.mean(q), "largest_q": jnp.max(jnp.abs(q))}


def reduce_over_updates(logs: dict[str, Array]) -> dict[str, Array]:
    """Return the logs ``loss/*`` of an iteration from those of its updates: means, and maxima of ``largest_*``."""
    return {f"loss/{name}": (jnp.max if is_largest(name) else jnp.mean)(x) for name, x in logs.items()}


def squared_error(q: Array, target: Array) -> Float[Array, ""]:
    """Return half the mean squared error of Q values from targets, over the batch and all critics."""
    return 0.5 * jnp.mean((q - target) ** 2)


def target_entropy(config: Any, environment: Environment) -> float:
    """Return the configured target entropy, by default minus the size of an action."""
    return -float(environment.action_size) if config.target_entropy is None else config.target_entropy


def sample_each(policy: Distribution, keys: Array) -> Float[Array, "B raw"]:
    """Sample a raw action from each distribution with its own key, independently of the rest of the batch."""
    return jax.vmap(type(policy).sample)(policy, keys)


class OffPolicy(Generic[Config]):
    """An off-policy algorithm in one environment: a subclass adds its losses and optimisers."""

    #: Names of networks that have a target network.
    targets: ClassVar[tuple[str, ...]] = ("critic",)
    optimiser: optax.GradientTransformationExtraArgs

    def __init__(self, config: Config, environment: Environment, data: Any) -> None:
        self.config, self.environment = config, environment
        self.spec = environment.shapes(data)
        # Traced only: no random numbers are drawn.
        networks = nnx.eval_shape(lambda: self.networks(jax.random.key(0)))
        self.graphs = {name: graph_of(network) for name, network in networks.items()}

    @property
    def network(self) -> NetworkConfig:
        """Configuration of all networks."""
        return self.config.network

    def networks(self, key: Array) -> dict[str, nnx.Module]:
        """Return all networks by name, with initial parameters."""
        actions = Actions(self.environment.action_size, self.environment.levels)
        policy_key, critic_key = jax.random.split(key)
        return {
            "policy": Policy(self.network, self.spec, nnx.Rngs(policy_key), actions),
            "critic": TwinCritic(self.network, self.spec, nnx.Rngs(critic_key), actions),
        }

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """Return the policy's action distribution."""
        return nnx.merge(self.graphs["policy"], parameters)(observation)

    def q_values(
        self, parameters: Any, observation: dict[str, Array], action: Float[Array, "*actions D"]
    ) -> Float[Array, "2 *actions"]:
        """Return the values of both critics."""
        return nnx.merge(self.graphs["critic"], parameters)(observation, action)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """Return the policy as a planner."""
        return NetworkPlanner(parameters, self.graphs["policy"], name, samples)

    #: Maps trained parameters, target networks and a batch to the sum of all losses and values to log; the gradient of
    #: each loss reaches only its own parameters.
    loss: Callable[..., tuple[Array, dict[str, Array]]]
    #: Maps trained parameters, target networks and a batch to values to log, and the gradient of the loss.
    gradient: Callable[..., tuple[dict[str, Array], Any]]

    def update_networks(self, carry: Carry, *batch: Any) -> tuple[Carry, dict[str, Array]]:
        """Take a gradient step of :meth:`loss` on a batch, then update the target networks."""
        trained, target, optimiser = carry
        logs, gradient = self.gradient(trained, target, *batch)
        for name in ("policy", "critic"):
            logs[f"{name}_gradient_norm"] = optax.tree.norm(gradient[name])
        updates, optimiser = self.optimiser.update(gradient, optimiser, trained)
        trained: Any = optax.apply_updates(trained, updates)
        online = {name: trained[name] for name in self.targets}
        return (trained, polyak(target, online, self.config.tau), optimiser), logs

    def critic_loss(
        self, trained: Trained, batch: Transitions, next_value: Float[Array, " B"]
    ) -> tuple[Float[Array, ""], Float[Array, "2 B"]]:
        """Return the squared TD error, given the values of the next states, and the Q values of the batch."""
        target = td_target(batch.reward, next_value, batch.terminated, batch.discount)
        q = self.q_values(trained["critic"], batch.observation, batch.action)
        return squared_error(q, target), q

    def soft_actor(
        self, trained: Trained, observation: dict[str, Array], entropy: float, keys: Array
    ) -> SoftActor:
        """Return the losses of a policy with entropy bonus and of its temperature, given the target entropy."""
        temperature = jnp.exp(trained["log_temperature"])
        policy = self.distribution(trained["policy"], observation)
        raw_action = sample_each(policy, keys)
        log_prob = policy.log_prob(raw_action)
        critic = jax.lax.stop_gradient(trained["critic"])
        q_values = self.q_values(critic, observation, policy.action(raw_action))
        return SoftActor(
            policy,
            q_values,
            soft_policy_loss(q_values, log_prob, temperature),
            jnp.mean(temperature_loss(trained["log_temperature"], log_prob, entropy)),
            {"entropy": -jnp.mean(log_prob), "temperature": temperature},
        )

"""TD3+BC (Fujimoto and Gu 2021, arXiv 2106.06860): a deterministic policy that maximises Q and imitates the expert."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from drivax.checks import check_at_least
from drivax.learning.algorithms.off_policy import Trained, q_logs
from drivax.learning.algorithms.offline import Offline, OfflineConfig, PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.program import mean_over_devices
from drivax.learning.replay import Transitions
from drivax.rl.equations import scaled_policy_loss, smoothed_action


@dataclass(frozen=True)
class Td3BcConfig(OfflineConfig):
    """TD3+BC. The policy acts by its mode; its standard deviation is not learned.

    Attributes:
        q_weight: Weight of ``-Q / mean |Q|`` relative to the squared imitation error; 0 is behaviour cloning.
        noise: Standard deviation of the noise on the target policy's action.
        noise_bound: Bound that the noise is clipped to.
        delay: The policy is updated in every n-th update.
    """

    kind: Literal["td3_bc"] = "td3_bc"
    q_weight: float = 2.5
    noise: float = 0.2
    noise_bound: float = 0.5
    delay: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_gradient()
        check_at_least(self, 0, "q_weight", "noise", "noise_bound")
        check_at_least(self, 1, "delay")

    def build(self, environment: Environment, data: Any, iterations: int) -> Td3Bc:
        """Return TD3+BC in an environment."""
        return Td3Bc(self, environment, data, iterations)


class Td3Bc(Offline[Td3BcConfig]):
    """TD3+BC in one environment. Every update also updates all target networks, even if it skips the policy."""

    targets: ClassVar[tuple[str, ...]] = ("critic", "policy")

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """Return the optimisers; that of the policy skips updates."""
        delay = self.config.delay
        policy = self.adam(self.config.policy_rate, delay)

        def is_due(step: Any, **_: Any) -> Any:
            return step % delay == delay - 1

        return super().optimisers() | {"policy": optax.conditionally_mask(policy, is_due)}

    def loss(
        self, trained: Trained, target: Any, batch: Transitions, policy_batch: PolicyBatch, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the critics' loss, minus the first critic's scaled value of the policy's action, plus imitation."""
        config = self.config
        next_action = self.distribution(target["policy"], batch.next_observation).mode()
        noise = config.noise * jax.vmap(partial(jax.random.normal, shape=next_action.shape[1:]))(keys)
        next_action = smoothed_action(next_action, noise, config.noise_bound)
        next_q = self.q_values(target["critic"], batch.next_observation, next_action)
        critic_loss, q = self.critic_loss(trained, batch, self.combine(next_q))

        observation, expert, guidance = policy_batch
        action = self.distribution(trained["policy"], observation).mode()
        policy_q = self.q_values(jax.lax.stop_gradient(trained["critic"]), observation, action)[0]
        error = action - expert
        imitation = jnp.mean(error**2)
        scaled = scaled_policy_loss(-policy_q, mean_over_devices(jnp.abs(policy_q)))
        policy = config.q_weight * jnp.mean(guidance * scaled) + imitation
        return critic_loss + policy, {
            "critic": critic_loss,
            "policy": policy,
            **q_logs(q),
            "mean_q_policy": jnp.mean(policy_q),
            "imitation": imitation,
            "imitation_error": jnp.mean(jnp.abs(error)),
        }

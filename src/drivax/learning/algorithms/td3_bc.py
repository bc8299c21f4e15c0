"""TD3+BC (Fujimoto and Gu 2021, arXiv 2106.06860): a deterministic policy between the best Q and the expert."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.learning.algorithms.offline import Improved, Offline, OfflineConfig, Trained
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.rl.offline import scaled_policy_loss, smoothed_action
from drivax.rl.temporal_difference import td_target


@dataclass(frozen=True)
class Td3BcConfig(OfflineConfig):
    """TD3+BC. The policy acts by its mode; the spread of its distribution is not learned.

    Attributes:
        q_weight: Of ``-Q / mean |Q|`` beside the squared error from the expert's action; 0 is behaviour cloning.
        noise: Standard deviation of the noise on the target policy's action.
        noise_bound: Where that noise is clipped.
        delay: The policy moves in every so manyth update.
    """

    kind: Literal["td3_bc"] = "td3_bc"
    q_weight: float = 2.5
    noise: float = 0.2
    noise_bound: float = 0.5
    delay: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_choices()
        if min(self.q_weight, self.noise, self.noise_bound) < 0.0 or self.delay < 1:
            raise UsageError(
                "settings of TD3+BC that cannot be", cure="use 0 or more, and a delay of 1 or more"
            )

    def build(self, environment: Environment, data: Any, iterations: int) -> Td3Bc:
        """TD3+BC in an environment."""
        return Td3Bc(self, environment, data, iterations)


class Td3Bc(Offline):
    """TD3+BC in one environment. Targets follow in every update, the policy's too, not only when the policy moves."""

    follows: ClassVar[tuple[str, ...]] = ("critic", "policy")

    def __init__(self, config: Td3BcConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config = config
        super().__init__(config, environment, data, iterations)

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """The policy's rests between its updates."""
        delay = self.config.delay
        policy = self.adam(self.config.policy_rate, delay)

        def moves(step: Any, **_: Any) -> Any:
            return step % delay == delay - 1

        return super().optimisers() | {"policy": optax.conditionally_mask(policy, moves)}

    def loss(
        self, trained: Trained, target: Mapping[str, Any], part: Transitions, improved: Improved, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Squared errors of the critics; the first critic's value of the policy's action, and imitation."""
        config = self.config
        then = self.distribution(target["policy"], part.following).mode()
        noise = config.noise * jax.random.normal(key, then.shape)
        then = smoothed_action(then, noise, config.noise_bound)
        value = jnp.min(self.q(target["critic"], part.following, then), axis=0)
        goal = td_target(part.reward, value, part.terminated, config.gamma)
        q = self.q(trained["critic"], part.observation, part.action)
        error = 0.5 * jnp.mean((q - goal) ** 2)

        observation, expert = improved
        action = self.distribution(trained["policy"], observation).mode()
        judged = self.q(jax.lax.stop_gradient(trained["critic"]), observation, action)[0]
        off = action - expert
        imitation = jnp.mean(off**2)
        policy = config.q_weight * jnp.mean(scaled_policy_loss(-judged, judged)) + imitation
        return error + policy, {
            "critic": error,
            "policy": policy,
            "mean_q": jnp.mean(q),
            "mean_q_policy": jnp.mean(judged),
            "imitation": imitation,
            "imitation_error": jnp.mean(jnp.abs(off)),
        }

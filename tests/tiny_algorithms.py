"""Algorithms with tiny networks and batches, which compile fast."""

from __future__ import annotations

from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.replay import ReplayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig

TINY = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,))
#: Small enough that six iterations write over the whole ring.
SAC = SacConfig(
    network=TINY,
    replay=ReplayConfig(32),
    environments=4,
    unroll=4,
    updates_per_step=1,
    batch=8,
    warm_up=16,
)
PPO = PpoConfig(network=TINY, environments=4, unroll=4, epochs=1, minibatches=2)
BC = BcConfig(batch=8, updates=2, network=TINY)

"""Every algorithm goes on from a checkpoint bit for bit, and keeps to the rules of algorithms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.learning.imitation import BcConfig, Cloning
from drivax.learning.ppo import PpoConfig
from drivax.learning.replay import ReplayConfig
from drivax.learning.sac import SacConfig
from drivax.learning.warm_start import BcPpoConfig, BcSacConfig, WarmStart
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.testing import check_algorithm
from drivax.tracking.checkpoints import Checkpoints
from pendulum import Demonstrations, Pendulum

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
START = WarmStart(iterations=2, cloning=Cloning(batch=8, updates=2), weight=0.5, half_life=2)
ALGORITHMS = {
    "bc": BcConfig(batch=8, updates=2, network=TINY),
    "sac": SAC,
    "sac_observations": replace(SAC, replay=ReplayConfig(32, "observation")),
    "ppo": PPO,
    "bc_sac": BcSacConfig(warm_start=START, sac=SAC),
    "bc_ppo": BcPpoConfig(warm_start=START, ppo=PPO),
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_resuming_is_bit_for_bit(name, tmp_path):
    """Stopped in the middle and restored from disk, a run ends in the very state of one that was not stopped."""
    data = Demonstrations({"angle": jnp.linspace(-3, 3, 50), "rate": jnp.zeros(50)}, jnp.zeros((50, 1)))
    learner = ALGORITHMS[name].build(Pendulum(), data, 6)
    iterate = jax.jit(learner.iterate, donate_argnums=1)
    state = jax.jit(learner.init)(data, jax.random.key(5))
    checkpoints = Checkpoints(tmp_path)
    for number in range(6):
        if number == 3:
            checkpoints.save(number, state)
        state, logs = iterate(data, state)
    # Restored into shapes alone, as a fresh process does.
    resumed = checkpoints.restore(jax.eval_shape(learner.init, data, jax.random.key(0)))
    for _ in range(3):
        resumed, again = iterate(data, resumed)
    jax.tree.map(np.testing.assert_array_equal, logs, again)
    jax.tree.map(np.testing.assert_array_equal, *(jax.tree.map(_plain, part) for part in (state, resumed)))


def _plain(leaf):
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bc", "sac", "bc_sac", "bc_ppo"])
def test_algorithms_keep_to_the_rules(name):
    config = ALGORITHMS[name]
    if name.startswith("bc_"):
        config = replace(config, warm_start=replace(START, iterations=1))
    if name == "sac":
        config = replace(SAC, warm_up=0)
    check_algorithm(config)

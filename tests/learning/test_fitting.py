"""Two scenarios are driven with success after a short run, by every online algorithm and bc, with every encoder.

Policies act by their mode, in closed loop to the end of the log, and are evaluated twenty times a run: two successes in
a row are enough. A small penalty for leaving the log helps algorithms that learn by reward. All sizes are small.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.rollout import drive
from drivax.learning.algorithms.behaviour_cloning import BcConfig, Cloning
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, BcSacConfig, WarmStart
from drivax.learning.driving import Driving
from drivax.learning.replay import ReplayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.attention import EntityConfig
from drivax.networks.encoders import MlpConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.features import Features
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

TINY = {"width": 32, "heads": 2, "layers": 1, "embedding": (32,)}
ENCODERS = {
    "mlp": MlpConfig(rows=(16,), hidden=(64, 64)),
    "lq": LqConfig(**TINY, latents=4),
    "lqh": LqhConfig(**TINY, latents=4),
    "mtr": MtrConfig(**TINY),
    "wayformer": WayformerConfig(**TINY, latents=4),
    "entity": EntityConfig(),
}
OBSERVATION = ObservationConfig(
    agents=4, steps=1, road=0, lights=1, route=8, features=Features(ego_static=("length", "width"))
)
TASK = Task(
    observation=OBSERVATION,
    rewards=RewardConfig(collision=-5.0, offroad=-5.0, red_light=-5.0, progress=0.05, log_divergence=-0.1),
    metrics=("success", "accuracy"),
)
CLONING = Cloning(batch=128, updates=250, learning_rate=3e-3)
PPO = PpoConfig(
    environments=64,
    unroll=32,
    epochs=4,
    minibatches=4,
    learning_rate=1e-3,
    gamma=0.95,
    entropy_coefficient=0.0,
)
SAC = SacConfig(
    replay=ReplayConfig(50_000),
    environments=16,
    unroll=16,
    updates_per_step=4,
    batch=128,
    warm_up=2_000,
    policy_rate=1e-3,
    critic_rate=1e-3,
    temperature_rate=1e-3,
    gamma=0.95,
    tau=0.01,
    temperature=0.02,
)
START = WarmStart(iterations=2, cloning=CLONING, weight=1.0, half_life=20)


def algorithm(name, encoder):
    """A configuration, and how many iterations it gets."""
    network = NetworkConfig(encoder=ENCODERS[encoder], head=(64,), first_scale=0.1)
    if name == "bc":
        return BcConfig(**vars(CLONING), network=network), 8
    if name == "ppo":
        return replace(PPO, network=replace(network, first_scale=0.3)), 300
    if name == "sac":
        return replace(SAC, network=replace(network, first_scale=0.3, activation="relu")), 240
    if name == "bc_ppo":
        ppo = replace(PPO, network=network, learning_rate=2e-4)
        return BcPpoConfig(warm_start=START, ppo=ppo), 300
    sac = replace(SAC, network=replace(network, activation="relu"), explore="policy", warm_up=512)
    return BcSacConfig(warm_start=START, sac=replace(sac, policy_rate=3e-4, temperature=0.005)), 240


@pytest.fixture(scope="module")
def bank():
    """A roundabout, and a junction with lights."""
    capacity = replace(CAPACITIES["default"], name="testing", agents=40, parked=24)
    recordings = [generate_recording(seed=0, index=index) for index in (0, 8)]
    return ScenarioBank.from_scenarios([assemble(one, capacity) for one in recordings], trim=False)


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("name", ["bc", "ppo", "sac", "bc_ppo", "bc_sac"])
def test_algorithms_overfit_two_scenarios(bank, name, encoder):
    config, iterations = algorithm(name, encoder)
    learner = config.build(Driving(Simulator(TASK), latest_start=60), bank, iterations)
    state = jax.jit(learner.init)(bank, jax.random.key(0))
    iterate = jax.jit(learner.iterate, donate_argnums=1)
    simulator = Simulator(replace(TASK, to_the_end=True))
    keys = jax.random.split(jax.random.key(1), 2)

    def success():
        planner = learner.planner(state.parameters, name, samples=False)
        return np.asarray(drive(simulator, planner, bank, jnp.arange(2), keys).metrics["success"].value)

    successes = [success().all()]
    assert not successes[0]
    for iteration in range(1, iterations + 1):
        state, _ = iterate(bank, state)
        if iteration % max(iterations // 20, 1) == 0:
            successes.append(success().all())
            if all(successes[-2:]):
                return
    pytest.fail(f"success in {sum(successes)} of {len(successes)} evaluations, never twice in a row")

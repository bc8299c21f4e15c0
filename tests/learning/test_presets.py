"""Every preset is a training run that can be built, and the published ones have the published numbers."""

from dataclasses import replace

import pytest

from drivax import settings
from drivax.learning.algorithms.awac import AwacConfig
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, BcSacConfig
from drivax.learning.config import TrainConfig
from drivax.tasks.observations import PRESETS

OFFLINE = {
    "bc": BcConfig,
    "cql": CqlConfig,
    "cql_bc": CqlConfig,
    "iql": IqlConfig,
    "awac": AwacConfig,
    "td3_bc": Td3BcConfig,
}
KINDS = {"bc": BcConfig, "sac": SacConfig, "ppo": PpoConfig, "bc_sac": BcSacConfig, "bc_ppo": BcPpoConfig}


@pytest.mark.parametrize("name", [name for name in settings.presets() if not name.startswith("studies/")])
def test_presets_load_and_round_trip(name):
    config = settings.load(TrainConfig, name)
    assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(config))) == config
    kind = name.removeprefix("published/")
    if kind in KINDS:
        assert type(config.algorithm) is KINDS[kind]
    if name.startswith("offline/"):
        assert type(config.algorithm) is OFFLINE[name.removeprefix("offline/")]
    # More than warming up or cloning.
    if hasattr(config.algorithm, "warm_start"):
        assert 0 < config.algorithm.warm_start.iterations < config.iterations


def test_every_algorithm_has_its_presets():
    names = set(settings.presets())
    assert set(KINDS) <= names
    assert {f"published/{kind}" for kind in KINDS if kind != "bc_ppo"} <= names
    assert {f"offline/{name}" for name in OFFLINE} <= names
    assert {f"published/{name}" for name in OFFLINE if name != "cql_bc"} <= names


def test_published_presets_have_the_published_defaults():
    """As the semantics list them (Learning, published defaults)."""
    sac = settings.load(TrainConfig, "published/sac")
    learner = sac.algorithm
    assert (sac.total_steps, learner.environments, learner.replay.capacity) == (25_000_000, 16, 1_000_000)
    assert (learner.warm_up, learner.batch, learner.updates_per_step) == (10_000, 256, 4)
    assert (learner.gamma, learner.tau, learner.temperature) == (0.99, 0.005, 0.1)
    assert learner.policy_rate == learner.critic_rate == learner.temperature_rate == 3e-4
    assert learner.target_entropy is None, "minus the size of an action, which is 2"
    ppo = settings.load(TrainConfig, "published/ppo")
    learner = ppo.algorithm
    assert (ppo.total_steps, learner.environments) == (200_000_000, 256)
    assert (learner.minibatches, learner.epochs, learner.clip, learner.lambda_) == (8, 4, 0.2, 0.95)
    assert learner.steps_per_iteration // learner.minibatches == 512
    assert (learner.value_coefficient, learner.entropy_coefficient, learner.gradient_norm) == (0.5, 0.01, 0.5)
    bc_sac = settings.load(TrainConfig, "published/bc_sac")
    cloning = (settings.load(TrainConfig, "published/bc").algorithm, bc_sac.algorithm.warm_start.cloning)
    assert {part.last_rate for part in (learner, *cloning)} == {1.0}, "rates stay"
    assert {part.gradient_norm for part in (sac.algorithm, bc_sac.algorithm.sac, *cloning)} == {None}
    for config in (sac, ppo, bc_sac):
        assert config.earliest_start == config.latest_start == 0, "episodes of 90 steps"
        assert config.task.observation == PRESETS["published"] and config.task.rewards.preset == "published"


def test_published_numbers_of_offline_algorithms():
    """CQL's as the long-tail study has them, the others' as their papers."""
    cql = settings.load(TrainConfig, "published/cql").algorithm
    # The study's penalty weighs 2 beside whole squared errors, which are halved here.
    assert (cql.penalty, cql.gamma, cql.tau, cql.batch, cql.actions) == (1.0, 0.9, 0.005, 512, 10)
    assert (cql.policy_rate, cql.critic_rate, cql.gradient_norm) == (1e-5, 3e-5, 1.0)
    assert not cql.importance and not cql.next_actions and cql.temperature_rate == 0.0
    assert settings.load(TrainConfig, "published/cql").total_steps == 510_000 * 512
    corl = settings.load(TrainConfig, "published/cql_corl").algorithm
    assert (corl.policy_rate, corl.critic_rate, corl.temperature_rate) == (3e-5, 3e-4, 3e-5)
    assert (corl.actions, corl.batch, corl.gamma, corl.tau) == (10, 256, 0.99, 0.005)
    assert corl.normalise and corl.importance and corl.next_actions and corl.network.head == (256, 256, 256)
    iql = settings.load(TrainConfig, "published/iql").algorithm
    assert (iql.expectile, iql.inverse_temperature, iql.largest_weight, iql.loss) == (
        0.7,
        3.0,
        100.0,
        "likelihood",
    )
    td3_bc = settings.load(TrainConfig, "published/td3_bc").algorithm
    assert (td3_bc.q_weight, td3_bc.noise, td3_bc.noise_bound, td3_bc.delay) == (2.5, 0.2, 0.5, 2)
    for other in (iql, td3_bc):
        assert (other.batch, other.gamma, other.tau, other.critic_rate) == (256, 0.99, 0.005, 3e-4)


def test_offline_presets_differ_in_the_algorithm_alone():
    configs = [settings.load(TrainConfig, f"offline/{name}") for name in OFFLINE]
    for config in configs[1:]:
        assert replace(config, algorithm=configs[0].algorithm) == configs[0]
        assert config.algorithm.network == configs[0].algorithm.network
        assert config.algorithm.steps_per_iteration == configs[0].algorithm.steps_per_iteration


def test_cql_bc_adds_only_imitation_to_the_baseline():
    alone, bc_sac = (settings.load(TrainConfig, f"offline/{name}").algorithm for name in ("cql", "cql_bc"))
    assert bc_sac.imitation > 0.0 and replace(bc_sac, imitation=0.0) == alone

"""All kernels against XLA on real recordings: episodes that leave the log, their observations, and the encoder."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.datasets.formats import detect
from drivax.evaluation.rollout import evaluation_task
from drivax.learning.config import TrainConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows
from drivax.simulator.ahead import ahead
from drivax.simulator.contact import Contact
from drivax.simulator.simulator import Simulator
from kernels.compare import assert_same, needs_kernels
from kernels.test_evaluation import assert_same_rows
from kernels.test_set_encoder import compare, problem

pytestmark = [needs_kernels, pytest.mark.slow]

PATTERNS = (
    "womd/motion_data_one_scenario.tfrecord",
    "scenarionet/*.pkl",
    "gpudrive/*.json",
    "av2/*/*.parquet",
)
SAMPLES, STEPS = 48, 25


@pytest.fixture(scope="module")
def scenarios(real_data):
    for module, extra in {"google.protobuf": "womd", "pyarrow": "av2"}.items():
        pytest.importorskip(module, reason=f"needs the extra {extra!r}")
    paths = [path for pattern in PATTERNS for path in sorted(real_data.glob(pattern))]
    assert len(paths) > 6
    return [assemble(next(windows(next(iter(detect(path).read(path)))))) for path in paths]


@pytest.fixture(scope="module")
def bank(scenarios):
    return ScenarioBank.from_scenarios(scenarios)


@pytest.fixture(scope="module")
def task():
    """All facts, and the observation of the presets."""
    task = settings.load(TrainConfig, "ppo").task
    return replace(evaluation_task(task), observation=task.observation)


@pytest.fixture(scope="module")
def episodes(bank, task):
    simulator = Simulator(task)

    def drive(bank, index, phase):
        """The facts, contacts, obstacles ahead and observations of an episode; the agent leaves its log."""

        def step(state, number):
            action = 0.5 * jnp.stack([jnp.sin(phase), jnp.cos(1.3 * phase + 0.2 * number)])
            state = simulator.step(bank, state, action)[0]
            frame = simulator.now(bank, state.context)
            observation = simulator.observe(bank, state.context)
            return state, (state.facts, state.contacts, ahead(bank, state.context, frame, 2.0), observation)

        return jax.lax.scan(step, simulator.reset(bank, index), jnp.arange(STEPS))[1]

    index = jnp.arange(SAMPLES, dtype=jnp.int32) % len(bank)
    phase = jnp.asarray(np.random.default_rng(0).uniform(0, 6, SAMPLES), jnp.float32)
    return assert_same(drive, (None, 0, 0), (bank, index, phase))


def test_episodes_on_real_maps_equal_those_of_xla(episodes):
    facts, contacts, obstacles, observation = episodes
    assert (contacts == Contact.APART).any()
    assert (facts.ttc_s < 5).any()
    assert (obstacles.gap < 90).any()
    assert observation["road_mask"].any() and observation["agents_mask"].any()


@pytest.mark.parametrize("group", ["road", "agents"])
def test_encoder_of_real_rows_equals_that_of_xla(episodes, group):
    observation = episodes[3]
    rows, valid = (jnp.asarray(observation[name]) for name in (group, f"{group}_mask"))
    rows, valid = (value.reshape(-1, *value.shape[2:]) for value in (rows, valid))
    (layers, _, _) = problem((1, 1, rows.shape[-1], 32), 0)
    compare(layers, rows.astype(jnp.float32), valid)


def test_evaluation_rows_equal_those_of_xla(scenarios):
    assert_same_rows("idm", scenarios)

"""Every algorithm goes on from a checkpoint bit for bit, keeps to the rules, and goes through its phases."""

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import DataError
from drivax.learning.algorithms.behaviour_cloning import Cloning
from drivax.learning.algorithms.warm_start import BcPpoConfig, BcSacConfig, WarmStart
from drivax.learning.config import TrainConfig
from drivax.learning.loop import mean_logs
from drivax.learning.policies import PretrainedRun, replace_networks
from drivax.learning.replay import ReplayConfig
from drivax.testing import check_algorithm
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from pendulum import Demonstrations, Pendulum
from tiny_algorithms import BC, PPO, SAC

START = WarmStart(iterations=2, cloning=Cloning(batch=8, updates=2), settle=2, weight=0.5, half_life=2)
ALGORITHMS = {
    "bc": BC,
    "sac": SAC,
    "sac_observations": replace(SAC, replay=ReplayConfig(32, "observation")),
    "ppo": PPO,
    "bc_sac": BcSacConfig(warm_start=START, sac=SAC),
    "bc_ppo": BcPpoConfig(warm_start=START, ppo=PPO),
}


#: Which networks SAC takes over from a run of each.
TAKEN = {
    "ppo": None,
    "bc": [".parameters"],
    "sac": [".parameters", ".critic", ".target"],
    "bc_sac": [".parameters", ".critic", ".target"],
}
#: The quick one.
FAST = "bc"
PARAMETERS = [name if name == FAST else pytest.param(name, marks=pytest.mark.slow) for name in ALGORITHMS]
SHOWN = Demonstrations({"angle": jnp.linspace(-3, 3, 50), "rate": jnp.zeros(50)}, jnp.zeros((50, 1)))


@pytest.fixture(scope="module", params=PARAMETERS)
def run(request):
    """A learner's compiled iteration, its states before each of six iterations and after, and what each logged."""
    learner = ALGORITHMS[request.param].build(Pendulum(), SHOWN, 6)
    state, iterate = jax.jit(learner.init)(SHOWN, jax.random.key(5)), jax.jit(learner.iterate)
    states, rows = [state], []
    for _ in range(6):
        state, raw = iterate(SHOWN, state)
        states.append(state)
        rows.append(raw)
    return request.param, learner, iterate, states, rows


def test_resuming_is_bit_for_bit(run, tmp_path):
    """Stopped in the middle and restored from disk, a run ends in the very state of one that was not stopped."""
    _, learner, iterate, states, rows = run
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(3, states[3])
    # Restored into shapes alone, as a fresh process does.
    state = checkpoints.restore(jax.eval_shape(learner.init, SHOWN, jax.random.key(0)))
    for number in range(3, 6):
        state, raw = iterate(SHOWN, state)
        jax.tree.map(np.testing.assert_array_equal, raw, rows[number])
    jax.tree.map(np.testing.assert_array_equal, *(jax.tree.map(_plain, part) for part in (state, states[-1])))


def test_warm_start_pretrains_and_then_reinforces(run):
    name, _, _, states, raw = run
    if not name.startswith("bc_"):
        pytest.skip("has one phase")
    rows = [mean_logs(row) for row in raw]
    same = partial(np.array_equal, equal_nan=True)  # an episode that began in the middle has no return
    initial, cloned, learned = (jax.device_get(states[number]) for number in (0, 2, 6))
    # Cloning moves the policy alone, and logs nothing of what it did not do.
    for part in ("environments", "optimiser", "iteration"):
        before, after = (jax.tree.leaves(getattr(state.learner, part)) for state in (initial, cloned))
        assert all(map(same, before, after)), part
    assert not all(map(same, *(jax.tree.leaves(state.parameters) for state in (initial, cloned))))
    for row in rows[:2]:
        assert "loss/imitation" in row and "loss/policy" not in row
        assert not any(name.startswith("reward/") for name in row)
    # Learning by reward goes on from the clone, with imitation beside it.
    for row in rows[2:]:
        assert {"reward/swing", "loss/policy", "loss/imitation"} <= set(row)
    assert (int(learned.iteration), int(learned.learner.iteration)) == (6, 4)
    # The policy stays the clone while values settle, and then no more; the values move at once.
    policies = [
        jax.tree.leaves(state.parameters["policy"] if name == "bc_ppo" else state.parameters)
        for state in map(jax.device_get, (states[2], states[4], states[6]))
    ]
    assert all(map(same, policies[0], policies[1])) and not all(map(same, policies[1], policies[2]))
    values = [
        jax.tree.leaves(state.parameters["value"] if name == "bc_ppo" else state.learner.critic)
        for state in map(jax.device_get, (states[2], states[4]))
    ]
    assert not all(map(same, *values))
    moved = jax.tree.leaves(initial.learner.environments), jax.tree.leaves(learned.learner.environments)
    assert not all(map(same, *moved))


@pytest.mark.slow
def test_networks_transfer_to_another_run(tmp_path):
    """SAC, hotter, from each of them: it gets all the networks that there are, and nothing else."""
    hot = replace(SAC, temperature=0.5).build(Pendulum(), SHOWN, 6)
    fresh = jax.jit(hot.init)(SHOWN, jax.random.key(5))
    run = RunFolder.create(tmp_path / "run", TrainConfig(), kind="training")
    for number, (name, expected_paths) in enumerate(TAKEN.items()):
        former = jax.jit(ALGORITHMS[name].build(Pendulum(), SHOWN, 6).init)(SHOWN, jax.random.key(6))
        Checkpoints(run.checkpoints).save(number, former)
        origin = PretrainedRun(run.path, number, [])
        if name == "ppo":
            with pytest.raises(DataError, match=r"no \.parameters.*; start from a run with the same network"):
                origin.networks(fresh)
            continue
        networks = origin.networks(jax.eval_shape(lambda: fresh))
        assert list(networks) == expected_paths
        state = replace_networks(fresh, networks)
        inner = former.learner if name == "bc_sac" else former
        same = {"parameters": former.parameters} | {
            path: getattr(inner, path) for path in ("critic", "target") if f".{path}" in expected_paths
        }
        for field in fields(fresh):
            expected = same.get(field.name, getattr(fresh, field.name))
            pairs = (jax.tree.map(_plain, part) for part in (getattr(state, field.name), expected))
            jax.tree.map(np.testing.assert_array_equal, *pairs)
        assert float(state.log_temperature) == pytest.approx(np.log(0.5))
    # And back into a warm start, where they lie one level deeper.
    both = jax.jit(ALGORITHMS["bc_sac"].build(Pendulum(), SHOWN, 6).init)(SHOWN, jax.random.key(7))
    networks = PretrainedRun(run.path, list(TAKEN).index("sac"), []).networks(both)
    assert list(networks) == [".parameters", ".learner.critic", ".learner.target"]
    jax.tree.map(
        np.testing.assert_array_equal,
        replace_networks(both, networks).learner.critic,
        networks[".learner.critic"],
    )


def _plain(leaf):
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bc", "sac", "bc_sac", "bc_ppo"])
def test_algorithms_pass_their_checks(name):
    config = ALGORITHMS[name]
    if name.startswith("bc_"):
        config = replace(config, warm_start=replace(START, iterations=1))
    if name == "sac":
        config = replace(SAC, warm_up=0)
    check_algorithm(config)

"""Trainings whose numbers are not finite stop at once and keep healthy checkpoints; damaged ones are passed over."""

import json
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.cli import main
from drivax.errors import DataError, DrivaxError
from drivax.files import PartialFolder, atomic_write, replace_folder
from drivax.learning import loop
from drivax.learning.algorithms.off_policy import reduce_over_updates
from drivax.learning.algorithms.optimisers import sum_gradients
from drivax.learning.algorithms.sac import _sums
from drivax.learning.algorithms.warm_start import BcPpoConfig, WarmStart
from drivax.learning.config import TrainConfig
from drivax.learning.environment import collect
from drivax.learning.loop import mean_logs, train
from drivax.learning.program import Program, Seeds
from drivax.learning.training_log import DivergenceError, large_logs, nonfinite_leaf, nonfinite_log, rank
from drivax.scenario.record import record
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder, seed_folders
from pendulum import Demonstrations, Pendulum
from tiny_algorithms import BC, PPO, SAC
from toy_learner import VALUES, Toy, ToyConfig

RATE = 1e30
FAST = {"bc": replace(BC, learning_rate=RATE), "ppo": replace(PPO, learning_rate=RATE)}
SLOW = {
    "ppo_average": replace(PPO, learning_rate=RATE, average=0.9),
    "bc_ppo": BcPpoConfig(warm_start=WarmStart(iterations=1, settle=1), ppo=replace(PPO, learning_rate=RATE)),
    "sac": replace(SAC, policy_rate=RATE, critic_rate=RATE, average=0.9),
}
SHOWN = Demonstrations({"angle": jnp.linspace(-3, 3, 50), "rate": jnp.zeros(50)}, jnp.zeros((50, 1)))


@pytest.fixture(scope="module")
def config():
    return settings.load(TrainConfig, VALUES)


def diverging(config, **values):
    return replace(config, algorithm=ToyConfig(**values))


def last_parameters(folder):
    shapes = jax.eval_shape(Toy(ToyConfig()).init, None, jax.random.key(0))
    return np.asarray(Checkpoints(folder / "checkpoints").restore(shapes).parameters)


def steps(folder):
    return Checkpoints(folder / "checkpoints").steps()


def iterate(settings, environment, seeds=(3,), iterations=4):
    """Yield the state, raw logs and device flags of each iteration."""
    program = Program(Seeds(settings.build(environment, SHOWN, iterations), seeds), SHOWN)
    state = program.initial_state()
    for _ in range(iterations):
        state, logs, finite = program.step(state)
        yield jax.device_get(state), jax.device_get(logs), np.asarray(finite)


def is_finite(state):
    """Oracle: all floats of a state in NumPy, other than environments and the replay buffer."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        inside = {getattr(key, "name", None) for key in path} & {"environments", "replay"}
        if (
            not inside
            and jnp.issubdtype(leaf.dtype, jnp.floating)
            and not np.isfinite(np.asarray(leaf)).all()
        ):
            return False
    return True


@pytest.mark.parametrize(
    "name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)], ids=str
)
def test_learning_rate_of_1e30_is_noticed_in_its_iteration(name):
    healthy = 0
    for state, logs, flag in iterate((FAST | SLOW)[name], Pendulum()):
        problem = nonfinite_log(mean_logs(logs)) or nonfinite_leaf(state)
        assert bool(flag) == is_finite(state)
        assert (nonfinite_leaf(state) is None) == is_finite(state)
        if problem is not None:
            assert problem.startswith(("loss/", ".parameters", ".trained", ".optimiser", ".log_temperature"))
            return
        healthy += 1
    pytest.fail(f"{healthy} healthy iterations")


@dataclass(frozen=True)
class NanReward(Pendulum):
    """A pendulum whose reward is NaN after three steps."""

    def step(self, data, now, cache, action, drawn):
        after, outcome = super().step(data, now, cache, action, drawn)
        reward = jnp.where(jnp.arange(len(now.over)) == 2, jnp.nan, outcome.reward)
        totals = outcome.totals | {"reward/swing": jnp.sum(jnp.where(now.over, 0.0, reward))}
        return after, replace(outcome, reward=reward, totals=totals)


@pytest.mark.parametrize("name", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_nan_reward_is_named_before_the_losses_that_it_spoils(name):
    _, logs, _ = next(iterate({"ppo": PPO, "sac": SAC}[name], NanReward(), iterations=1))
    assert nonfinite_log(mean_logs(logs)) == "reward/swing is NaN"


@pytest.mark.parametrize(("value", "expected"), [(0.5, None), (jnp.nan, "NaN"), (-jnp.inf, "infinite")])
def test_actions_of_a_rollout_are_logged_and_named(value, expected):
    """One of three pendulums has another action at one of four steps; that of one whose episode is over is NaN."""

    def actor(observation, key):
        is_first = (observation["pendulum"] == start.observation["pendulum"]).all(axis=1)
        action = jnp.where(is_first, jnp.array([-0.25, value, jnp.nan]), -0.25)[:, None]
        return action, action, {}

    environment, key = Pendulum(), jax.random.key(0)
    start = replace(environment.start((), key, 3), over=jnp.array([False, False, True]))
    *_, sums = collect(environment, (), start, actor, key, 4)
    row = mean_logs({f"rollout/{name}": total for name, total in sums.items()})
    if expected is None:
        assert nonfinite_log(row) is None and row["rollout/action_magnitude"] == (10 * 0.25 + 0.5) / 11
    else:
        assert nonfinite_log({"reward/swing": jnp.nan} | row) == f"rollout/action_magnitude is {expected}"


def test_healthy_state_is_finite_although_environments_are_not():
    """Pendulums that began in the middle of an episode have a return of NaN."""
    for state, logs, flag in iterate(PPO, Pendulum(), seeds=(3, 4), iterations=1):
        assert np.isnan(state.environments.state.earned).any()
        assert flag.tolist() == [True, True] and nonfinite_leaf(state) is None
        assert all(nonfinite_log(mean_logs({name: x[n] for name, x in logs.items()})) is None for n in (0, 1))


@record
class Leaves:
    parameters: object
    replay: object


def test_flags_are_those_of_each_seed():
    seeds = Seeds(Toy(ToyConfig()), (0, 1, 2))
    leaves = [jnp.array([[0.0, 1.0], [jnp.inf, 0.0], [2.0, 3.0]]), jnp.zeros((3, 3)).at[2, 1].set(jnp.nan)]
    assert seeds.all_finite(leaves).tolist() == [True, False, False]
    state = Leaves({"a": leaves[0][2], "b": leaves[1][2], "n": jnp.zeros(2, int)}, jnp.full(2, jnp.nan))
    assert nonfinite_leaf(state) == ".parameters['b'] is NaN"
    assert nonfinite_leaf(replace(state, parameters={"a": leaves[0][1]})) == ".parameters['a'] is infinite"
    assert nonfinite_leaf(replace(state, parameters={"a": leaves[0][0]})) is None


def test_divergence_stops_before_a_checkpoint_is_written(data, config, tmp_path):
    run = tmp_path / "run"
    wrong = diverging(config, nan_at=4)
    for resume in (False, True):  # Resuming repeats the iterations after the last healthy checkpoint.
        with pytest.raises(DivergenceError) as raised:
            train(wrong, data, run, validation=None, resume=resume)
        assert raised.value.status == 1
        assert str(raised.value) == (
            f"{run}: training diverged at step 40: .parameters is NaN; lower the learning rate and start a new run "
            f"from the last healthy checkpoint: --from {run}@20"
        )
        assert steps(run) == [20] and np.isfinite(last_parameters(run)).all()
        assert [row["step"] for row in RunFolder.open(run).read_metrics()] == [10, 20, 30, 40]
    started = train(replace(config, begin_from=f"{run}@20"), data, tmp_path / "cured", validation=None)
    assert steps(started.path)[-1] == 60


@pytest.mark.parametrize(
    ("values", "line"),
    [
        (
            {"nan_at": 1},
            "diverged at step 10: .parameters is NaN; lower the learning rate and start again with --ov",
        ),
        (
            {"nan_at": 3, "nan_in": "loss"},
            "at step 30: loss/toy is NaN; lower the learning rate and start a new",
        ),
        (
            {"nan_at": 3, "nan_in": "reward"},
            "reward/hurry is NaN; correct the reward term hurry and start a new",
        ),
    ],
)
def test_command_names_what_diverged_in_one_line(values, line, data, config, tmp_path, capsys):
    file = tmp_path / "toy.yaml"
    file.write_text(settings.dump(diverging(config, **values)))
    arguments = ["train", str(file), "--data", str(data.path), "--out", str(tmp_path / "run")]
    assert main([*arguments, "--validation", "none"]) == 1
    errors = [row for row in capsys.readouterr().err.splitlines() if row.startswith("drivax: ")]
    assert len(errors) == 1 and line in errors[0]


def test_other_seeds_train_to_the_end(data, config, tmp_path):
    healthy = train(config, data, tmp_path / "healthy", seeds=3, validation=None)
    lines, run = [], tmp_path / "run"
    wrong = diverging(config, nan_at=4, nan_seed=5)
    message = r"seed-5: training diverged at step 40: .*--from .*seed-5@20"
    with pytest.raises(DivergenceError, match=message):
        train(wrong, data, run, seeds=3, validation=None, log=lines.append)
    assert "seed 5: diverged at 40 steps: .parameters is NaN" in lines
    assert [steps(run / f"seed-{seed}") for seed in (4, 5, 6)] == [[40, 60], [20], [40, 60]]
    # A resumed run leaves the seed as it is, and the others end as before.
    for seed in (4, 6):
        shutil.rmtree(run / f"seed-{seed}" / "checkpoints" / "step-000000060")
    before = (run / "seed-5" / "metrics.jsonl").read_bytes()
    with pytest.raises(DivergenceError, match=message):
        train(wrong, data, run, resume=True)
    assert (run / "seed-5" / "metrics.jsonl").read_bytes() == before
    for seed in (4, 6):
        expected = last_parameters(healthy.path / f"seed-{seed}")
        np.testing.assert_array_equal(last_parameters(run / f"seed-{seed}"), expected)


def test_actions_that_are_not_finite_leave_no_best_checkpoint(data, config, tmp_path, monkeypatch):
    scores = iter([0.5, None])

    def validate(*_):
        score = next(scores)
        if score is None:
            raise DivergenceError("actions of the policy are not finite in 1 of 3 episodes")
        return {"validation/vmax_score": score}

    monkeypatch.setattr(loop, "validate", validate)
    with pytest.raises(DivergenceError, match=r"step 40: actions of the policy .* --from .*@20"):
        train(replace(config, evaluate_every=2), data, tmp_path / "run", validation=data)
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints")
    assert checkpoints.steps() == [20] and checkpoints.best() == 20


def test_infinite_value_ranks_last():
    assert rank("fitted_q", {"validation/fitted_q": float("inf")}) == (-float("inf"),)
    assert rank("success", {"validation/success": float("inf"), "validation/vmax_score": 0.5}) == (-1.0, 0.5)


def test_large_values_warn_once(data, config, tmp_path):
    lines = []
    train(diverging(config, kl=1.5), data, tmp_path / "run", validation=None, log=lines.append)
    warnings = [line for line in lines if line.startswith("warning: ")]
    assert warnings == ["warning: seed 4: loss/kl is 1.5, beyond 1 at 10 steps: training may diverge"]
    logs = {"loss/largest_q": 1.01e4, "loss/kl": 0.9, "loss/policy": 1e9}
    assert large_logs(logs) == {"loss/largest_q": "loss/largest_q is 1.01e+04, beyond 10000"}
    assert large_logs({"loss/mean_q": -1.01e4}) == {"loss/mean_q": "loss/mean_q is -1.01e+04, beyond 10000"}


def test_largest_values_are_maxima_over_updates_and_chunks():
    logs = {"mean_q": jnp.array([1.0, 2.0, 6.0]), "largest_q": jnp.array([4.0, 9.0, 6.0])}
    assert reduce_over_updates(logs) == {"loss/mean_q": 3.0, "loss/largest_q": 9.0}
    assert mean_logs(_sums(logs)) == {"loss/mean_q": 3.0, "loss/largest_q": 9.0}

    def loss(parameters, x):
        logs = {"mean_q": jnp.sum(x) / 4, "largest_q": jnp.max(jnp.abs(x))}
        return parameters["largest_slope"] * jnp.sum(x) / 4, logs

    for chunks in (1, 2, 4):
        samples = jnp.array([1.0, -7.0, 3.0, 5.0]).reshape(chunks, -1)
        result = sum_gradients(loss, {"largest_slope": jnp.array(2.0)}, samples)
        assert result == ({"mean_q": 0.5, "largest_q": 7.0}, {"largest_slope": 0.5})


def damage(checkpoint):
    file = max(
        (file for file in checkpoint.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size
    )
    os.truncate(file, file.stat().st_size // 2)


def test_resume_passes_over_damaged_checkpoints(data, config, tmp_path):
    whole, run = (train(config, data, tmp_path / name, validation=None).path for name in ("whole", "run"))
    checkpoints = run / "checkpoints"
    damage(checkpoints / "step-000000060")
    lines = []
    train(config, data, run, validation=None, resume=True, log=lines.append)
    (warning,) = [line for line in lines if line.startswith("warning: ")]
    assert "step-000000060" in warning and warning.endswith("; resumes from step 40")
    np.testing.assert_array_equal(last_parameters(run), last_parameters(whole))
    # One that an earlier version wrote with NaN is passed over, too.
    shapes = jax.eval_shape(Toy(ToyConfig()).init, None, jax.random.key(0))
    state = Checkpoints(checkpoints).restore(shapes)
    Checkpoints(checkpoints).write(60, replace(state, parameters=state.parameters * jnp.nan))
    train(config, data, run, validation=None, resume=True, log=lines.append)
    assert "checkpoint of step 60: .parameters is NaN; resumes from step 40" in lines[-1]
    np.testing.assert_array_equal(last_parameters(run), last_parameters(whole))
    for step in (40, 60):
        damage(checkpoints / f"step-{step:09d}")
    with pytest.raises(
        DataError, match=r"step-000000060.*; use another checkpoint, or train again"
    ) as raised:
        train(config, data, run, validation=None, resume=True)
    assert "\n" not in str(raised.value) and steps(run) == [40, 60]


def test_damaged_older_checkpoint_does_not_end_a_training(data, config, tmp_path):
    run = train(config, data, tmp_path / "run", validation=None).path
    shutil.rmtree(run / "checkpoints" / "step-000000060")
    about = run / "checkpoints" / "step-000000020" / "about.json"
    about.parent.mkdir()
    about.write_text("{")
    train(config, data, run, validation=None, resume=True)
    assert steps(run) == [40, 60]


class Killed(BaseException):
    """End of a process."""


def test_files_of_a_killed_training_are_taken_over(data, config, tmp_path, monkeypatch):
    run = train(config, data, tmp_path / "run", seeds=2, validation=None).path
    seed = run / "seed-4"
    checkpoint = seed / "checkpoints" / "step-000000060"
    (seed / "checkpoints" / ".step-40.old-7").mkdir()
    for write in (atomic_write(seed / "run.json"), replace_folder(checkpoint)):
        with monkeypatch.context() as context, pytest.raises(Killed), write:
            context.setattr(Path, "unlink", lambda *_, **__: None)
            context.setattr(PartialFolder, "close", PartialFolder._release)
            raise Killed
    litter = [".run.json.partial", ".step-000000060.partial", ".step-40.old-7"]
    assert sorted(path.name for path in seed.rglob(".*")) == litter
    train(config, data, run, validation=None, resume=True)
    assert [path.name for path in seed.rglob(".*")] == []
    # Killed after the first of two seeds has its folder.
    shutil.rmtree(run / "seed-5")
    shutil.rmtree(seed / "checkpoints")
    info = json.loads((seed / "run.json").read_text())
    train(config, data, run, validation=None, resume=True)
    assert [steps(path) for path in seed_folders(run)] == [[40, 60], [40, 60]]
    again = json.loads((run / "seed-5" / "run.json").read_text())
    assert all(again[name] == info[name] for name in ("kind", "validation", "weights", "data"))
    shutil.rmtree(run / "seed-5" / "checkpoints")
    with pytest.raises(
        DataError, match="seeds have no checkpoint of the same step; start again with --overwrite"
    ):
        train(config, data, run, validation=None, resume=True)


def kill_at(step, monkeypatch):
    """Kill the process before seed 5 writes its checkpoint of a step."""
    write = Checkpoints.write

    def write_or_die(self, number, state, score=None):
        if number == step and "seed-5" in str(self.folder):
            raise Killed
        return write(self, number, state, score)

    monkeypatch.setattr(Checkpoints, "write", write_or_die)


def test_training_of_seeds_that_is_killed_at_its_first_checkpoint_starts_again(
    data, config, tmp_path, monkeypatch
):
    """Without the ranks of the killed process, which would use up patience."""
    config, whole, run = replace(config, evaluate_every=2, patience=2), tmp_path / "whole", tmp_path / "run"
    monkeypatch.setattr(loop, "validate", lambda *_: {"validation/vmax_score": 0.5})
    train(config, data, whole, seeds=2, validation=data)
    with monkeypatch.context() as context, pytest.raises(Killed):
        kill_at(20, context)
        train(config, data, run, seeds=2, validation=data)
    assert [steps(path) for path in seed_folders(run)] == [[20], []]
    train(config, data, run, validation=data, resume=True)
    for seed in ("seed-4", "seed-5"):
        assert steps(run / seed) == steps(whole / seed) == [40, 60]
        np.testing.assert_array_equal(last_parameters(run / seed), last_parameters(whole / seed))


def test_seeds_keep_a_common_checkpoint_until_all_have_the_next(data, config, tmp_path, monkeypatch):
    """A process that is killed between the checkpoints of two seeds can resume, also with keep 1."""
    run = tmp_path / "run"
    kill_at(40, monkeypatch)
    with pytest.raises(Killed):
        train(replace(config, keep=1), data, run, seeds=2, validation=None)
    assert [steps(path) for path in seed_folders(run)] == [[20, 40], [20]]


def test_memory_that_runs_out_is_one_line(data, config, tmp_path, monkeypatch):
    def step(*_):
        text = (
            "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 13743895347 bytes.\nBufferAssignment"
        )
        raise jax.errors.JaxRuntimeError(text)

    monkeypatch.setattr(Program, "step", step)
    with pytest.raises(
        DrivaxError, match=r"out of memory in training; memory: .*: no room for an array of 14 GB; "
    ):
        train(config, data, tmp_path / "run", validation=None)


def test_linked_folder_of_a_seed_is_refused(config, data, tmp_path):
    run = tmp_path / "run"
    train(config, data, run, seeds=2, validation=None)
    (run / "seed-5").rename(tmp_path / "elsewhere")
    (run / "seed-5").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match="seed-5: is a symbolic link; replace the link"):
        train(config, data, run, validation=None, resume=True)

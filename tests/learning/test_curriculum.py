"""Curricula: which scenarios and weights a stage has, when it ends, and that a run continues in the same stage."""

import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from drivax import settings
from drivax.errors import DataError, UsageError
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.config import Residency, TrainConfig
from drivax.learning.curriculum import Advance, Curriculum, Stage, mean_rollout
from drivax.learning.loop import train
from drivax.learning.program import Program, Seeds
from drivax.learning.residency import Residents
from drivax.learning.training_set import Source
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import seed_folders
from drivax.tracking.sinks import read_rows
from tiny_algorithms import PPO

TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2), metrics="training")
STAGES = (
    Stage("few", 48, ("tracks<=30",), rewards={"collision": 0.5}, rewards_at_end={"progress": 3.0}),
    Stage("all", 1000, reward_scale=2.0),
)
ENTRIES = [{"tags": {"type": kind}} for kind in ("turn_left", "straight", "turn_left", "turn_right")]


@pytest.fixture(scope="module")
def stages(scenarios):
    """The stages, of which the first has the half of the scenarios with the fewest agents."""
    tracks = sorted(entry["source"]["tracks"] for entry in scenarios.entries)
    return (replace(STAGES[0], filters=(f"tracks<={tracks[2]}",)), STAGES[1])


def config_of(stages, iterations=8, **changes):
    steps = iterations * PPO.steps_per_iteration
    config = TrainConfig(task=TASK, algorithm=PPO, curriculum=tuple(stages), total_steps=steps, seed=1)
    return replace(config, devices=1, checkpoint_every=2, keep=9, **changes)


def of_stages(*stages, steps=10):
    return Curriculum(stages, ENTRIES, {"collision", "progress"}, {"success"}, steps)


def test_a_stage_has_the_scenarios_of_its_filters():
    curriculum = of_stages(
        Stage("left", 20, ("type=turn_left",)), Stage("turns", 20, ("type!=straight",)), Stage("all", 1)
    )
    shares = []
    for _ in range(5):
        shares.append(curriculum.scenarios.tolist())
        curriculum.log({})
    left, turns, all_of_them = [1, 0, 1, 0], [1, 0, 1, 1], [1, 1, 1, 1]
    assert shares == [left, left, turns, turns, all_of_them]
    # The last stage has no end.
    for _ in range(9):
        curriculum.log({})
    assert curriculum.stage.name == "all"


def test_factors_change_linearly_over_the_budget():
    stage = Stage(
        "s",
        40,
        reward_scale=2.0,
        rewards={"collision": 0.5},
        rewards_at_end={"collision": 1.5, "progress": 0.0},
    )
    curriculum = of_stages(stage)
    factors = []
    for _ in range(6):
        factors.append((curriculum.factors["collision"], curriculum.factors["progress"]))
        curriculum.log({})
    expected = [(1.0, 2.0), (1.5, 1.5), (2.0, 1.0), (2.5, 0.5), (3.0, 0.0), (3.0, 0.0)]
    np.testing.assert_allclose(factors, expected)


def test_a_stage_ends_early_when_its_metric_passes_over_enough_episodes():
    stages = Stage("first", 10**6, advance=Advance("success", 0.9, 200)), Stage("second", 1)
    curriculum = of_stages(*stages)
    # Brute force: the newest iterations that together have at least 200 episodes.
    rng, history = np.random.default_rng(0), []
    for _ in range(400):
        row = {
            "rollout/success": float(np.clip(rng.normal(0.89, 0.05), 0, 1)),
            "rollout/episodes": float(rng.integers(0, 90)),
        }
        curriculum.log(row)
        history.append(tuple(row.values()))
        newest, total, passed = 0.0, 0.0, False
        for value, count in reversed(history):
            newest, total = newest + value * count, total + count
            if total >= 200:
                passed = newest / total >= 0.9
                break
        assert (curriculum.number == 1) == passed
        if passed:
            break
    assert passed
    curriculum.log({"rollout/success": 0.0, "rollout/episodes": 500.0})
    assert curriculum.number == 1


def test_metrics_of_seeds_are_means_over_all_episodes():
    rows = [
        {"rollout/success": 0.5, "rollout/episodes": 30.0, "loss/x": 1.0},
        {"rollout/success": 1.0, "rollout/episodes": 10.0},
        {"rollout/episodes": 0.0},
        # As in the log of a seed that diverged.
        {"rollout/success": None, "rollout/episodes": None},
    ]
    assert mean_rollout(rows) == {"rollout/success": 0.625, "rollout/episodes": 40.0}
    assert mean_rollout([]) == {"rollout/episodes": 0}


def test_impossible_stages_are_refused(scenarios, tmp_path):
    with pytest.raises(
        UsageError, match=r"stage 's': unknown reward term 'colision'; did you mean .?collision"
    ):
        of_stages(Stage("s", 1, rewards={"colision": 1.0}))
    with pytest.raises(
        DataError, match="stage 's': no scenario to train on meets type=u_turn; use fewer or weaker"
    ):
        of_stages(Stage("s", 1, ("type=u_turn",)))
    with pytest.raises(
        UsageError, match=r"stage 's': unknown metric of rollouts 'sucess'; did you mean .?success"
    ):
        of_stages(Stage("s", 1, advance=Advance("sucess")))
    with pytest.raises(UsageError, match="stage 's': a factor of the reward is nan; use a finite number"):
        Stage("s", 1, rewards={"collision": float("nan")})
    with pytest.raises(UsageError, match="stage 'all' begins after 48 of 48 steps; raise total_steps"):
        config_of(STAGES, 3)
    with pytest.raises(UsageError, match="duplicate stage 'few'"):
        config_of((STAGES[0], STAGES[0]))
    with pytest.raises(UsageError, match="is not a filter"):
        Stage("s", 1, ("type",))
    with pytest.raises(UsageError, match="a curriculum needs an algorithm that drives"):
        config_of(STAGES[:1]).__class__(algorithm=CqlConfig(), curriculum=STAGES[:1])
    with pytest.raises(
        UsageError, match="a curriculum needs all scenarios on the device; leave out residency"
    ):
        config_of(STAGES[1:], residency=Residency(4, 2))
    with pytest.raises(
        UsageError, match="a curriculum needs all scenarios on the device; leave out --memory"
    ):
        train(config_of(STAGES[1:]), scenarios, tmp_path / "run", validation=None, memory=10**6)
    assert not (tmp_path / "run").exists()


def test_episodes_and_rewards_follow_the_stage(scenarios, stages):
    config = config_of(stages)
    residents = Residents.of(Source.of(config, scenarios, None, (), ()), None)
    bank = residents.load()
    learner = config.algorithm.build(residents.source.environment, bank, config.iterations)
    program = Program(Seeds(learner, (0,)), residents.complete(bank))
    few = np.flatnonzero(residents.curriculum.scenarios)
    assert len(few) == 3
    state = program.initial_state()
    assert set(np.asarray(state.environments.state.context.index).tolist()) <= set(few.tolist())
    # The same step without the curriculum: its reward terms times the factors.
    factors = residents.curriculum.factors
    environment, plain = residents.source.environment, replace(program.data, reward_factors=None)
    action = jax.random.uniform(jax.random.key(3), (4, 2), minval=-1.0)
    results = []
    for data in (program.data, plain):
        drawn = environment.draw(data, jax.random.key(1), 4)
        cache = environment.cache(data, state.environments.state)
        results.append(environment.step(data, state.environments, cache, action, drawn)[1])
    scaled, unscaled = results
    for name, term in unscaled.terms.items():
        np.testing.assert_allclose(scaled.terms[name], factors[name.partition("/")[0]] * term, rtol=1e-6)
    np.testing.assert_allclose(scaled.reward, sum(scaled.terms.values()), rtol=1e-5, atol=1e-6)
    assert factors["collision"] == 0.5 and residents.note() == {"curriculum/stage": 1.0}
    # Three iterations of 16 steps are the budget of the first stage.
    lines = [residents.follow(program, {}) for _ in range(3)]
    assert lines[:2] == [None, None] and lines[2] == "stage 2 of 2, all: 8 scenarios"
    assert float(program.data.reward_factors["progress"]) == 2.0
    chances = np.diff(np.asarray(program.data.chances, np.int64), prepend=0)
    assert (chances > 0).all()
    residents.close()


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 2])
def test_a_resumed_run_continues_in_its_stage(scenarios, stages, seeds, tmp_path):
    lines = []
    config = config_of(stages)
    whole = train(config, scenarios, tmp_path / "whole", validation=None, seeds=seeds, log=lines.append)
    assert "stage 1 of 2, few: 3 scenarios" in lines
    assert "stage 2 of 2, all: 8 scenarios, from step 48" in lines

    def logged(path):
        """Return what each seed logged, without times."""
        folders = [path] if seeds == 1 else seed_folders(path)
        tables = [read_rows(folder / "metrics.jsonl") for folder in folders]
        return [
            [{n: v for n, v in row.items() if n != "steps_per_second"} for row in rows] for rows in tables
        ]

    expected = logged(whole.path)
    assert [[row["curriculum/stage"] for row in rows] for rows in expected] == [[1.0] * 3 + [2.0] * 5] * seeds
    for iterations in (2, 4):
        killed = tmp_path / f"killed-{iterations}"
        shutil.copytree(whole.path, killed)
        for folder in [killed] if seeds == 1 else seed_folders(killed):
            Checkpoints(folder / "checkpoints").drop_after(iterations * PPO.steps_per_iteration)
        train(config, scenarios, killed, validation=None, resume=True)
        assert logged(killed) == expected


def test_stages_are_read_from_yaml(tmp_path):
    (tmp_path / "stages.yaml").write_text(
        "curriculum:\n"
        "- {name: few, steps: 100, filters: ['agents<=8'], rewards: {collision: 0.5}, advance: {above: 0.8}}\n"
        "- {name: all, steps: 200}\n"
    )
    config = settings.load(TrainConfig, tmp_path / "stages.yaml")
    assert config.curriculum[0].advance == Advance("success", 0.8, 200)
    assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(config))) == config

"""Compare off-policy estimates of policies with their true returns, which only a simulator gives.

python -m experiments.learning.off_policy estimate --data BENCHMARK --runs RUNS
python -m experiments.learning.off_policy table    (write the stored results to the page)

RUNS is the folder of `experiments.learning.mixtures`, with its trained policies. Episodes of the mixture `mixed` in 256
scenarios of the split `validation` are the data of the estimates. Each policy acts by its mode with Gaussian noise (a
kernel), and so does the behaviour policy, a clone of these episodes: deterministic policies have no importance ratios.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.files import write_json
from drivax.learning.algorithms.off_policy_evaluation import FittedQ, FittedQConfig, estimate_return
from drivax.learning.algorithms.offline import OfflineConfig, policy_returns
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import Experience, ExperienceConfig
from drivax.learning.policies import load_policy
from drivax.learning.training_set import prepare_episodes, read_episodes, recorded_environment
from drivax.networks.distributions import SquashedGaussian
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.stats.ranking import correlation_interval, rank_correlation
from drivax.tracking.run_folder import RunFolder, versions
from experiments.learning.mixtures import ALGORITHMS_OF, PAGE, SEEDS, is_trained
from experiments.learning.tables import table
from experiments.repository import RESULTS, fill_places

RESULT = RESULTS / "off_policy.json"
SCENARIOS, UPDATES, GAMMA = 256, 2000, 0.97
#: Standard deviation of the kernels of all policies, before the squashing.
SCALE = 0.3
ESTIMATORS = ("fitted_q", "weighted_importance_sampling", "doubly_robust")


def prepare(data: Path, runs: Path) -> tuple[Driving, Experience, TrainConfig]:
    """Return the environment and the episodes to estimate from, and the settings of a trained policy."""
    scenarios, episodes = runs / "held-out", runs / "episodes" / "held-out"
    calls = (
        (scenarios, ["export", str(data / "validation"), str(scenarios), "--limit", str(SCENARIOS)]),
        (episodes, ["record", "mixed", "--data", str(scenarios), "--out", str(episodes)]),
    )
    for out, arguments in calls:
        if not out.exists():
            subprocess.run([sys.executable, "-m", "drivax", *arguments], check=True)
    config = RunFolder.open(runs / "mixed" / "iql" / "seed-0").config(TrainConfig)
    opened = ScenarioSet.open(scenarios)
    tables = read_episodes([episodes], opened, config.task)
    environment = recorded_environment(Driving(Simulator(config.task)), tables)
    recorded = prepare_episodes(environment, ScenarioBank.from_scenarios(opened), opened, tables)
    return environment, ExperienceConfig().of(environment, recorded), config


def action_of(run: Path, bank: ScenarioBank) -> Any:
    """Return the function from a batch of observations to the modes of a trained policy."""
    planner: Any = load_policy(run, bank)[0]
    key = jax.random.key(0)
    return jax.vmap(lambda observation: planner.choose(bank, None, observation, key))


def kernel(act: Any, observation: Any) -> SquashedGaussian:
    """Return a Gaussian around the mode of a policy."""
    location = jnp.arctanh(jnp.clip(act(observation), -0.999, 0.999))
    return SquashedGaussian(location, jnp.full_like(location, SCALE))


def estimates(
    environment: Any, data: Experience, config: TrainConfig, act: Any, behaviour: Any
) -> dict[str, float]:
    """Return the estimated returns of a policy, its true return, and the least effective number of episodes."""
    assert isinstance(config.algorithm, OfflineConfig)
    network = config.algorithm.networks
    evaluation = FittedQ(FittedQConfig(updates=UPDATES), network, environment, GAMMA)
    policy, source = partial(kernel, act), partial(kernel, behaviour)

    @jax.jit
    def run(data: Experience) -> dict[str, Any]:
        q = evaluation.fit(data, act)
        sampled = estimate_return(environment, data, policy, source, q, GAMMA)
        returns, *_ = policy_returns(environment, data.data.bank, act, GAMMA)
        first = jnp.argmax(data.expert.usable, axis=1)
        observation = environment.observe_recorded(data.data, (jnp.arange(len(first)), first))
        return {
            "fitted_q": q(observation, act(observation)).mean(),
            **{name: estimate.value for name, estimate in sampled.items()},
            "effective": sampled["doubly_robust"].effective,
            "return": returns.mean(),
        }

    return {name: float(value) for name, value in jax.device_get(run(data)).items()}


def compute_results(data_path: Path, runs: Path) -> dict[str, Any]:
    """Return the estimates and true returns of all policies, and the rank correlation of each estimator."""
    environment, data, config = prepare(data_path, runs)
    bank = data.data.bank
    behaviour = action_of(runs / "mixed" / "bc" / "seed-0", bank)
    rows = {}
    for mixture, names in ALGORITHMS_OF.items():
        for name in names:
            for seed in range(SEEDS):
                run = runs / mixture / name / f"seed-{seed}"
                if not is_trained(run):
                    continue
                row = estimates(environment, data, config, action_of(run, bank), behaviour)
                rows[f"{mixture}/{name}/seed-{seed}"] = row
                print(run, row, flush=True)
    columns = {key: np.array([row[key] for row in rows.values()]) for key in (*ESTIMATORS, "return")}
    clusters = np.array([name.rpartition("/")[0] for name in rows])  # seeds of one algorithm are dependent
    correlations = {
        name: {
            "rank_correlation": rank_correlation(columns[name], columns["return"]),
            "interval": list(correlation_interval(columns[name], columns["return"], clusters, 2000)),
        }
        for name in ESTIMATORS
    }
    command = "python -m experiments.learning.off_policy estimate --data BENCHMARK --runs RUNS"
    return {"command": command, "policies": rows, "correlations": correlations, "versions": versions()}


def page_tables(results: dict[str, Any]) -> dict[str, list[str]]:
    """Return the tables of the page: the estimators' rank correlations, and all estimates."""
    correlations = [
        [
            name.replace("_", " "),
            "{:+.2f} [{:+.2f}, {:+.2f}]".format(own["rank_correlation"], *own["interval"]),
        ]
        for name, own in results["correlations"].items()
    ]
    columns = ("return", *ESTIMATORS, "effective")
    policies = [
        [name, *(f"{row[column]:.2f}" for column in columns)] for name, row in results["policies"].items()
    ]
    headings = ["policy", *(column.replace("_", " ") for column in columns)]
    return {
        "correlations": table(["estimator", "rank correlation with the true return"], correlations),
        "policies": table(headings, policies),
    }


def main() -> None:
    """Estimate the returns of all policies, and store them with their rank correlations."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("table")
    estimating = commands.add_parser("estimate")
    estimating.add_argument("--data", type=Path, required=True)
    estimating.add_argument("--runs", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "estimate":
        write_json(RESULT, compute_results(args.data, args.runs))
    else:
        PAGE.write_text(
            fill_places(PAGE.read_text(), "off_policy.py", page_tables(json.loads(RESULT.read_text())))
        )


if __name__ == "__main__":
    main()

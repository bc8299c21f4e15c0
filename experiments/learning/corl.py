"""Compare our CQL with CORL's on the same data: episodes of mixed quality of Gymnasium's pendulum.

python -m experiments.learning.corl collect --out DATA          (a Minari data set of three controllers)
python -m experiments.learning.corl drivax --data DATA          (learns with three seeds)
python -m experiments.learning.corl corl --data DATA --code CQL (the same by CORL's code)

CQL is CORL's file algorithms/offline/cql.py (github.com/corl-team/CORL, 5790218), which needs PyTorch; its other
imports are not used. Both have the settings of ``configs/published/cql_corl.yaml`` with a conservative penalty of
weight 10 (the squared error has 1), but a smaller batch, fewer actions and equal rates, so that a run takes minutes.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from drivax.files import write_json
from drivax.tracking.run_folder import versions
from experiments.repository import RESULTS

RESULT = RESULTS / "corl.json"
TASK, TORQUE, STEPS = "Pendulum-v1", 2.0, 200
#: Episodes of each controller, seeds of each program, and episodes that evaluate a policy.
EPISODES, SEEDS, EVALUATED = 20, 3, 20
UPDATES, BATCH, ACTIONS, RATE, GAMMA, TAU, PENALTY = 10_000, 64, 4, 3e-4, 0.99, 0.005, 10.0
Controller = Callable[[np.ndarray, np.random.Generator], float]


def swing_up(observation: np.ndarray, rng: np.random.Generator, noise: float = 0.5) -> float:
    """Return the torque of a controller that pumps energy and balances near the top, with noise."""
    cosine, sine, rate = observation
    energy = rate**2 / 6.0 + 5.0 * (cosine - 1.0)  # of a rod of 1 m and 1 kg, 0 at rest at the top
    balance = -10.0 * np.arctan2(sine, cosine) - 2.0 * rate
    torque = balance if cosine > 0.85 else -np.sign(rate) * np.sign(energy)
    return float(np.clip(TORQUE * torque + noise * rng.normal(), -TORQUE, TORQUE))


CONTROLLERS: dict[str, Controller] = {
    "random": lambda _, rng: float(rng.uniform(-TORQUE, TORQUE)),
    "medium": partial(swing_up, noise=2.0),
    "good": swing_up,
}


def collect(out: Path) -> None:
    """Let Minari collect the episodes of all controllers."""
    os.environ["MINARI_DATASETS_PATH"] = str(out.parent.parent)
    from minari import DataCollector

    env, rng = DataCollector(gymnasium.make(TASK)), np.random.default_rng(0)
    returns: dict[str, list[float]] = {}
    for name, controller in CONTROLLERS.items():
        for number in range(EPISODES):
            observation, _ = env.reset(seed=1000 * len(returns) + number)
            rewards = []
            for _ in range(STEPS):
                action = np.array([controller(observation, rng)], np.float32)
                observation, reward, *_ = env.step(action)
                rewards.append(float(reward))
            returns.setdefault(name, []).append(sum(rewards))
    env.create_dataset(f"{out.parent.name}/{out.name}")
    store("data", {name: summary(values) for name, values in returns.items()})


def evaluate(act: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the mean return of a policy, which maps observations to actions in [-1, 1]."""
    envs = [gymnasium.make(TASK) for _ in range(EVALUATED)]
    observations = [env.reset(seed=100_000 + number)[0] for number, env in enumerate(envs)]
    total = 0.0
    for _ in range(STEPS):
        actions = act(np.stack(observations))
        steps = [env.step(TORQUE * action) for env, action in zip(envs, actions, strict=True)]
        observations = [step[0] for step in steps]
        total += sum(float(step[1]) for step in steps)
    return total / EVALUATED


def learn(data: Path) -> None:
    """Learn by CQL with each seed, and store the returns of the policies."""
    import jax
    from jax import numpy as jnp

    from drivax.adapters.minari import read_minari
    from drivax.learning.algorithms.cql import CqlConfig
    from drivax.learning.experience import LoggedEnvironment
    from drivax.networks.actor_critic import NetworkConfig
    from drivax.networks.encoders import MlpConfig

    @dataclass(frozen=True)
    class Stored(LoggedEnvironment):
        """Stored episodes as an environment of logged steps."""

        action_size: int = 1
        levels: None = None

        def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
            return {name: values.shape[2:] for name, values in data.observation.items()}

        def expert_steps(self, data: Any) -> Any:
            return data.steps

        def observe_recorded(self, data: Any, index: Any) -> Any:
            return {name: values[index] for name, values in data.observation.items()}

    episodes, environment = read_minari(data), Stored()
    config = CqlConfig(
        network=NetworkConfig(encoder=MlpConfig(hidden=()), head=(256, 256, 256), activation="relu"),
        normalise=True, batch=BATCH, updates=100, gamma=GAMMA, tau=TAU, policy_rate=RATE, critic_rate=RATE,
        gradient_norm=1e9, penalty=PENALTY / 2, actions=ACTIONS, temperature=1.0, temperature_rate=RATE,
    )  # fmt: skip
    experience = config.experience(environment, episodes, None)
    learner: Any = config.build(environment, episodes, UPDATES // config.updates)
    iterate = jax.jit(learner.iterate)
    returns = []
    for seed in range(SEEDS):
        state = learner.init(experience, jax.random.key(seed))
        for _ in range(UPDATES // config.updates):
            state, logs = iterate(experience, state)
        act = jax.jit(
            lambda x, policy=state.parameters: learner.distribution(policy, {"observation": x}).mode()
        )
        returns.append(evaluate(lambda x, act=act: np.asarray(act(jnp.asarray(x)))))
        print(seed, returns[-1], {name: round(float(value), 3) for name, value in logs.items()}, flush=True)
    store("drivax", summary(returns))


def learn_by_corl(data: Path, code: Path) -> None:
    """Learn by CORL's code with each seed, and store the returns of the policies."""
    import torch

    from drivax.adapters.minari import read_minari

    cql = load_code(code)
    steps = read_minari(data)
    observation, expert = np.asarray(steps.observation["observation"]), steps.steps
    usable = np.asarray(expert.usable)
    now, after = observation[usable], observation[:, 1:][usable[:, :-1]]
    mean, deviation = now.mean(axis=0), now.std(axis=0) + 1e-3
    content = {
        "observations": (now - mean) / deviation, "next_observations": (after - mean) / deviation,
        "actions": np.asarray(expert.action)[usable], "rewards": np.asarray(expert.reward)[usable],
        "terminals": np.asarray(expert.terminated)[usable].astype(np.float32),
    }  # fmt: skip
    buffer = cql.ReplayBuffer(3, 1, len(now))
    buffer.load_d4rl_dataset(content)
    returns = []
    for seed in range(SEEDS):
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - CORL draws from it
        critics = [cql.FullyConnectedQFunction(3, 1, True, 3) for _ in range(2)]
        adam = partial(torch.optim.Adam, lr=RATE)
        actor = cql.TanhGaussianPolicy(3, 1, 1.0, 1.0, orthogonal_init=True)
        trainer = cql.ContinuousCQL(
            critics[0], adam(critics[0].parameters()), critics[1], adam(critics[1].parameters()), actor,
            adam(actor.parameters()), target_entropy=-1.0, discount=GAMMA, policy_lr=RATE, qf_lr=RATE,
            soft_target_update_rate=TAU, bc_steps=0, cql_n_actions=ACTIONS, cql_alpha=PENALTY,
        )  # fmt: skip
        for _ in range(UPDATES):
            logs = trainer.train(buffer.sample(BATCH))
        actor.eval()

        def act(observations: np.ndarray, actor: Any = actor) -> np.ndarray:
            return np.stack([actor.act((x - mean) / deviation) for x in observations])

        returns.append(evaluate(act))
        print(seed, returns[-1], logs, flush=True)
    store("corl", summary(returns))


def load_code(path: Path) -> Any:
    """Import CORL's file, with empty modules in place of those that only its own command needs."""
    wrap = types.SimpleNamespace(wrap=lambda: lambda function: function)
    stubs = {"d4rl": None, "wandb": None, "pyrallis": wrap, "gym": types.SimpleNamespace(Env=object)}
    for name, content in stubs.items():
        module = types.ModuleType(name)
        vars(module).update(vars(content) if content is not None else {})
        sys.modules.setdefault(name, module)
    spec = importlib.util.spec_from_file_location("corl_cql", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def summary(returns: list[float]) -> dict[str, Any]:
    """Return the mean and the values, rounded."""
    return {"mean": round(float(np.mean(returns)), 1), "returns": [round(value, 1) for value in returns]}


def store(name: str, content: dict[str, Any]) -> None:
    """Store a part of the results."""
    results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    command = "python -m experiments.learning.corl"
    write_json(RESULT, results | {"command": command, name: content, "versions": versions()})


def main() -> None:
    """Collect the data, or learn from them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("collect").add_argument("--out", type=Path, required=True)
    for name in ("drivax", "corl"):
        command = commands.add_parser(name)
        command.add_argument("--data", type=Path, required=True)
        if name == "corl":
            command.add_argument("--code", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "collect":
        collect(args.out)
    elif args.command == "drivax":
        learn(args.data)
    else:
        learn_by_corl(args.data, args.code)


if __name__ == "__main__":
    main()

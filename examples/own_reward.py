"""Add your own reward term, check it, and train with it."""

import tempfile
from pathlib import Path

import jax.numpy as jnp

import drivax
from drivax.learning import PpoConfig, TrainConfig
from drivax.testing import check_reward


def tailgating(before, now, around):
    """1 while closer than 5 m to the nearest agent at more than 5 m/s."""
    return ((now.gap_m < 5.0) & (now.speed_mps > 5.0)).astype(jnp.float32)


check_reward(tailgating)
rewards = drivax.RewardConfig(
    preset="behaviour", own=(drivax.OwnTerm(tailgating, weight=-0.1, reads=("gap_m",)),)
)
config = TrainConfig(
    task=drivax.Task(rewards=rewards),
    algorithm=PpoConfig(environments=4, unroll=8, minibatches=2, epochs=1),
    total_steps=64,
)
folder = Path(tempfile.mkdtemp())
drivax.generate(folder / "set", scenarios=4, seed=0)
run = drivax.train(config, drivax.ScenarioSet.open(folder / "set"), folder / "run")
last = run.read_metrics()[-1]
print({name: value for name, value in last.items() if "tailgating" in name})

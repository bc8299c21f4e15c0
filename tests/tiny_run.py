"""A run folder of a tiny policy as training leaves it, but for the training."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from drivax import settings
from drivax.learning.config import TrainConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.traffic.log import LogTraffic
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder

TINY = {
    "task": {
        "observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 2},
        "metrics": "none",
    },
    "algorithm": {
        "kind": "ppo", "network": {"encoder": {"rows": [4], "hidden": [8]}, "head": [4]},
        "environments": 2, "unroll": 2, "minibatches": 1,
    },
    "traffic": "idm", "start": {"kind": "noisy_start"},
}  # fmt: skip


class Learned(NamedTuple):
    """Of a state of training what is looked at here."""

    parameters: Any


def write_run(path: Path, bank: ScenarioBank, **task: Any) -> RunFolder:
    """Two checkpoints of drawn weights, at steps 4 and 8, of which the older scored better."""
    config = settings.load(TrainConfig, TINY | {"task": TINY["task"] | task})
    folder = RunFolder.create(path, config, kind="training", validation="c0de")
    about = {"path": "/some/where/train", "hash": "f00d", "scenarios": 3}
    folder = folder.note(data=[about], command="drivax train tiny")
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, 1)
    shapes = jax.eval_shape(lambda key: learner.init(bank, key).parameters, jax.random.key(0))
    for step, score in ((4, 0.5), (8, 0.4)):
        rng = np.random.default_rng(step)
        drawn = jax.tree.map(lambda leaf, rng=rng: rng.normal(size=leaf.shape).astype(np.float32), shapes)
        Checkpoints(folder.checkpoints).save(step, Learned(drawn), score)
    return folder

"""Learn from logged steps, weighted by how critical they are, and evaluate the policy."""

import tempfile
from dataclasses import replace
from pathlib import Path

import drivax
from drivax import settings
from drivax.curation import WeightConfig, sampling_weights
from drivax.learning import TrainConfig, TrainingSet, usable_steps

folder = Path(tempfile.mkdtemp())
data = drivax.generate(folder / "set", scenarios=8, seed=0)
config = settings.load(TrainConfig, "offline/cql")
config = replace(config, total_steps=2 * config.algorithm.steps_per_iteration)
scores = drivax.curate("kinematic", data)
weights = sampling_weights(scores, WeightConfig(), "step", usable_steps(config, data))
run = drivax.train(config, TrainingSet(data, weights), folder / "run")
metrics = drivax.evaluate(run.path, folder / "set").summary()["metrics"]
print("success", metrics["success"]["mean"], "of", metrics["success"]["n"])

"""Evaluate your own planner and IDM, and print their metrics."""

import tempfile
from pathlib import Path

import jax.numpy as jnp

import drivax
from drivax.testing import check_planner


@drivax.jax_planner
def cruise(situation, observation):
    """Follow the route at 8 m/s, and brake if the time to collision is below 3 s."""
    facts = situation.facts
    ahead, left = 50.0 * observation["route"][1, :2]  # second route point in ego's frame, m
    curvature = 2.0 * left / (ahead**2 + left**2 + 1e-6)
    brake = facts.ttc_defined & (facts.ttc_s < 3.0)
    return jnp.where(brake, -1.0, (8.0 - facts.speed_mps) / 6.0), jnp.clip(curvature / 0.3, -1.0, 1.0)


check_planner(cruise)
folder = Path(tempfile.mkdtemp())
drivax.generate(folder / "set", scenarios=8, seed=0)
data = drivax.load(folder / "set")
for name, planner in {"cruise": cruise, "idm": "idm"}.items():
    metrics = drivax.evaluate(planner, data, traffic="idm").summary()["metrics"]
    print(name, {metric: metrics[metric]["mean"] for metric in ("success", "collision")})

"""Convert your own arrays to a scenario set and evaluate the expert on it."""

import tempfile
from pathlib import Path

import numpy as np

import drivax
from drivax.scenario import CAPACITIES

time_s = np.arange(91) * 0.1
ego = np.stack((12.0 * time_s - 40.0, 0.0 * time_s), axis=-1)
van = np.stack((8.0 * time_s, 0.0 * time_s + 3.5), axis=-1)
agents = {
    "xy": np.stack((ego, van)),  # [agent, time, 2], m
    "heading": np.zeros((2, 91)),  # rad, counter-clockwise from +x
    "valid": np.ones((2, 91), bool),
    "size": [(4.6, 1.9, 1.5), (5.9, 2.1, 2.6)],  # length, width, height, m
    "kind": ["vehicle", "vehicle"],
}
roads = {
    "lanes": [
        {"points": [(-80, 0), (160, 0)], "left": [1], "limit_mps": 13.9},
        {"points": [(-80, 3.5), (160, 3.5)], "limit_mps": 13.9},
    ],
    "edges": [[(-80, -2), (160, -2)], [(160, 5.5), (-80, 5.5)]],  # drivable space on the left
}
scenario = drivax.scenario_from_arrays("drive-0001", agents, roads, dataset="mine")
folder = Path(tempfile.mkdtemp())
with drivax.ScenarioWriter(folder / "set", CAPACITIES["default"]) as writer:
    writer.add(scenario)
metrics = drivax.evaluate("expert", folder / "set").summary()["metrics"]
print("expert: off-road", metrics["offroad"]["mean"], "collision", metrics["collision"]["mean"])

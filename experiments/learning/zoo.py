"""Put the policy of a trained seed into the zoo, with what it cost and how it drives on the validation split.

python -m experiments.learning.zoo NAME PRESET --seed SEED --data BENCHMARK [--half]

`presets.py collect` has stored it in experiments/state/policies. `--half` rounds its parameters to half precision,
which makes its file a third smaller.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.learning.policies import POLICY_FILE, export_policy, load_policy
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.seal import seal
from drivax.tracking.run_folder import RunFolder
from experiments.learning.benchmark import POLICIES
from experiments.learning.presets import CORE_SECONDS
from experiments.repository import ROOT

ZOO = ROOT / "src" / "drivax" / "zoo"
METRICS = (
    "success", "accuracy", "at_fault_collision", "collision", "offroad", "red_light", "vmax_score",
    "progress_ratio", "comfortable", "ttc_ok", "lane_keeping",
)  # fmt: skip


def round_parameters(folder: Path) -> None:
    """Round the parameters of an exported policy to half precision."""
    file = folder / POLICY_FILE
    with np.load(file, allow_pickle=False) as arrays:
        rounded = {name: arrays[name].astype(np.float16).astype(arrays[name].dtype) for name in arrays.files}
    np.savez_compressed(file, allow_pickle=False, **rounded)
    seal(folder, POLICY_FILE)


def measure(seed: Path, validation: ScenarioSet) -> dict[str, Any]:
    """Return the means of a policy's metrics on the validation split in log replay traffic."""
    scenarios = list(validation)
    bank = ScenarioBank.from_scenarios(scenarios)
    planner, task = load_policy(seed, bank)
    metrics = evaluate(planner, bank, scenario_names(scenarios), task=task).metrics
    return {name: round(float(np.nanmean(metrics[name])), 4) for name in METRICS}


def main() -> None:
    """Export and measure one policy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name")
    parser.add_argument("preset")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--half", action="store_true")
    args = parser.parse_args()
    validation = ScenarioSet.open(args.data / "validation")
    bank = ScenarioBank.from_scenarios([validation[0]])
    with tempfile.TemporaryDirectory() as top:
        seed = Path(top) / args.name
        shutil.copytree(POLICIES / args.preset / f"seed-{args.seed}", seed)
        if args.half:
            round_parameters(seed)
        measured = {
            "validation": {"scenarios": len(validation), "hash": validation.hash},
            CORE_SECONDS: RunFolder.open(seed).info[CORE_SECONDS],
            "ego": measure(seed, validation),
        }
        export_policy(seed, ZOO / args.name, bank, {"measured": measured}, overwrite=True)
    print(json.dumps(measured["ego"]))


if __name__ == "__main__":
    main()

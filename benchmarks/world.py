"""The built-in world: scenarios per second, rejected draws, share per family, and how gently the expert drives.

Run: python benchmarks/world.py --scenarios 64 --out world.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from collections import Counter
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from drivax.scenario.recording import Recording
from drivax.scenario.schema import DT_S
from drivax.synthetic.generate import GeneratedSet, Generation, generate
from drivax.synthetic.world import WORLD_VERSION, WorldConfig, generate_one

#: Limits of comfort (nuPlan): low and high.
LIMITS = {
    "longitudinal acceleration": (-4.05, 2.40),
    "lateral acceleration": (-4.89, 4.89),
    "longitudinal jerk": (-4.13, 4.13),
    "jerk magnitude": (-8.37, 8.37),
    "yaw rate": (-0.95, 0.95),
    "yaw acceleration": (-1.93, 1.93),
}


def smoothed(values: Any, window: int, order: int, derivative: int = 0) -> np.ndarray:
    """Savitzky-Golay filter or derivative of a quantity over time."""
    return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=DT_S))


def comfort(recording: Recording) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of each quantity over ego's log, with nuPlan's Savitzky-Golay windows."""
    speed = np.hypot(*recording.tracks.velocity[0].T)
    heading = np.unwrap(recording.tracks.heading[0])
    rate = smoothed(heading, 15, 2, 1)
    along = smoothed(np.gradient(speed, DT_S), 8, 2)
    aside = smoothed(speed * rate, 8, 2)
    jerk_along, jerk_aside = smoothed(along, 15, 2, 1), smoothed(aside, 15, 2, 1)
    yaw = smoothed(heading, 15, 3, 2)
    values = (along, aside, jerk_along, np.hypot(jerk_along, jerk_aside), rate, yaw)
    return {name: (float(v.min()), float(v.max())) for name, v in zip(LIMITS, values, strict=True)}


def speeds(scenarios: int, seed: int) -> tuple[dict[str, float], GeneratedSet]:
    """Scenarios per second end to end (draw, assemble, write) with one and two workers."""
    rates, result = {}, None
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            result = generate(Path(folder) / "set", scenarios, seed, Generation(workers=workers))
        rates[f"workers_{workers}"] = scenarios / result.seconds
    assert result is not None
    return rates, result


def measure(scenarios: int, seed: int) -> dict[str, Any]:
    """Everything that the table shows."""
    rates, result = speeds(scenarios, seed)
    drawn = [generate_one(seed, index, WorldConfig()) for index in range(scenarios)]
    extremes = [comfort(one.recording) for one in drawn]
    within = {
        name: float(np.mean([low <= e[name][0] and e[name][1] <= high for e in extremes]))
        for name, (low, high) in LIMITS.items()
    }
    moved = [np.hypot(*np.diff(one.recording.tracks.xy[0], axis=0).T).sum() for one in drawn]
    events = Counter(one.tags["event"] for one in drawn if "event" in one.tags)
    return {
        "scenarios": scenarios,
        "seed": seed,
        "scenarios_per_second": rates,
        "families": {
            name: {
                "share": count.kept / scenarios,
                "rejection_rate": count.rejection_rate,
                "causes": count.rejected,
            }
            for name, count in result.families.items()
        },
        "comfortable_share": within,
        "ego_moves_m": {f"p{p}": float(np.percentile(moved, p)) for p in (5, 50, 95)},
        "vehicles_mean": float(np.mean([len(one.recording.tracks.kind) for one in drawn])),
        "events": dict(events),
        "versions": {
            "drivax": metadata.version("drivax"),
            "world": WORLD_VERSION,
            "numpy": np.__version__,
            "python": platform.python_version(),
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
        },
    }


def table(result: dict[str, Any]) -> str:
    """The result for people."""
    rows = [("scenarios", f"{result['scenarios']} (seed {result['seed']})")]
    rows += [
        (f"scenarios/s, {k.replace('_', ' ')}", f"{v:.1f}") for k, v in result["scenarios_per_second"].items()
    ]
    for name, family in result["families"].items():
        causes = ", ".join(f"{k} {v}" for k, v in family["causes"].items()) or "none"
        rows.append(
            (name, f"{family['share']:.0%} of scenarios, {family['rejection_rate']:.1%} rejected ({causes})")
        )
    rows += [(f"expert within {name}", f"{share:.1%}") for name, share in result["comfortable_share"].items()]
    moves = result["ego_moves_m"]
    rows.append(("ego moves", f"{moves['p50']:.0f} m (5-95 %: {moves['p5']:.0f} to {moves['p95']:.0f} m)"))
    rows.append(("vehicles per scenario", f"{result['vehicles_mean']:.1f}"))
    rows.append(("events", ", ".join(f"{k} {v}" for k, v in result["events"].items()) or "none"))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def main() -> None:
    """Measures, prints the table, and writes the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("world.json"))
    args = parser.parse_args()
    result = measure(args.scenarios, args.seed)
    print(table(result))
    partial = args.out.with_name(f".{args.out.name}.partial")
    partial.write_text(json.dumps(result, indent=2) + "\n")
    partial.replace(args.out)


if __name__ == "__main__":
    main()

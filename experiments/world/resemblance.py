"""Compare the built-in world with real recordings: one figure, medians, Kolmogorov-Smirnov distances.

Compares ego and every other vehicle that is always valid, stays within 50 m of ego on average and drives at least 5 m,
in the world and the recordings. The recordings come from a few places and do not represent any data set, so differences
in the number of agents may reflect these places.

Run: python -m experiments.world.resemblance --data ../shared/data --scenarios 256 [--write]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import savgol_filter
from scipy.stats import ks_2samp

from drivax.datasets.formats import find_reader, survey
from drivax.errors import DrivaxError, UsageError
from drivax.report.pictures.palette import BLUE, VERMILLION
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows
from drivax.scenario.schema import CAPACITIES, DT_S, STEPS, AgentKind, Scenario
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.world import WORLD_VERSION, WorldConfig, generate_one
from experiments.repository import DOCS, RESULTS, save_picture
from experiments.world.measures import all_agents

FIGURE = DOCS / "guide" / "world-resemblance.png"
RESULT = RESULTS / "world_resemblance.json"

Array = np.ndarray[Any, Any]
#: Label, and range in the figure, by quantity.
QUANTITIES = {
    "speed": ("speed (m/s)", (0.0, 30.0)),
    "acceleration": ("acceleration (m/s2)", (-4.0, 4.0)),
    "yaw_rate": ("yaw rate (rad/s)", (-0.6, 0.6)),
    "leader_m": ("distance to the leader (m)", (0.0, 60.0)),
    "leader_s": ("time gap to the leader (s)", (0.0, 6.0)),
    "agents": ("agents within 50 m", (0.0, 80.0)),
    "nearest_m": ("distance to the nearest agent (m)", (0.0, 40.0)),
}
#: First panels of the rows of the figure.
FIRST_IN_ROW = tuple(QUANTITIES)[::3]
#: Minimum distance that a compared vehicle drives, m.
MIN_DISTANCE_M = 5.0
#: Maximum mean distance of a compared vehicle from ego, whose sensors record its surroundings, m.
NEAR_EGO_M = 50.0
#: Maximum distance of counted agents from a compared vehicle, m.
COUNTED_WITHIN_M = 50.0
#: Maximum gap to a leader, and its maximum lateral distance from the subject's axis, m. Headings differ by at most 45
#: degrees.
LEADER_M, LEADER_LATERAL_M = 60.0, 1.6
#: Minimum speed for yaw rates and time gaps, which are meaningless at standstill.
MIN_SPEED_MPS = 2.0
#: Use every fifth step, since neighbouring steps are nearly equal.
STRIDE = 5


def quantities(scenario: Scenario) -> dict[str, Array]:
    """Return the quantities of all compared vehicles and steps of one scenario."""
    box, velocity, valid, kind, _ = all_agents(scenario)
    subjects = np.flatnonzero(valid.all(axis=0) & (kind == AgentKind.VEHICLE))
    distance = np.hypot(*np.moveaxis(np.diff(box[:, subjects, :2], axis=0), -1, 0)).sum(axis=0)
    ego_distance = np.hypot(*np.moveaxis(box[:, subjects, :2] - box[:, :1, :2], -1, 0)).mean(axis=0)
    subjects = subjects[(subjects == 0) | ((distance >= MIN_DISTANCE_M) & (ego_distance < NEAR_EGO_M))]
    vehicles = [_subject(row, box, velocity, valid, kind) for row in subjects]
    return {name: np.concatenate([vehicle[name] for vehicle in vehicles]) for name in QUANTITIES}


def _subject(row: int, box: Array, velocity: Array, valid: Array, kind: Array) -> dict[str, Array]:
    steps = slice(0, None, STRIDE)
    heading = np.unwrap(np.arctan2(box[:, row, 3], box[:, row, 2]))
    speed = np.hypot(*velocity[:, row].T)
    slope = {"window_length": 15, "polyorder": 2, "deriv": 1, "delta": DT_S}
    acceleration, yaw_rate = savgol_filter(speed, **slope)[steps], savgol_filter(heading, **slope)[steps]
    speed, box_of_subject, others = speed[steps], box[steps, row], box[steps]
    present = valid[steps].copy()
    present[:, row] = False
    offset = others[..., :2] - box_of_subject[:, None, :2]
    distance = np.where(present, np.hypot(offset[..., 0], offset[..., 1]), np.inf)
    gap = _leader_gap(box_of_subject, others, offset, present & (kind == AgentKind.VEHICLE))
    has_leader, is_moving = gap < LEADER_M, speed > MIN_SPEED_MPS
    nearest_m = distance.min(axis=1, initial=np.inf)
    return {
        "speed": speed,
        "acceleration": acceleration,
        "yaw_rate": yaw_rate[is_moving],
        "leader_m": gap[has_leader],
        "leader_s": gap[has_leader & is_moving] / speed[has_leader & is_moving],
        "agents": (distance < COUNTED_WITHIN_M).sum(axis=1).astype(np.float64),
        "nearest_m": nearest_m[np.isfinite(nearest_m)],
    }


def _leader_gap(subject: Array, others: Array, offset: Array, present: Array) -> Array:
    """Return the bumper-to-bumper distance to the leader at every step, infinite without one."""
    cos, sin = subject[:, None, 2], subject[:, None, 3]
    ahead = offset[..., 0] * cos + offset[..., 1] * sin
    lateral = np.abs(offset[..., 1] * cos - offset[..., 0] * sin)
    same_direction = others[..., 2] * cos + others[..., 3] * sin > np.cos(np.pi / 4)
    gap = ahead - (others[..., 4] + subject[:, None, 4]) / 2
    is_leader = present & same_direction & (lateral < LEADER_LATERAL_M) & (gap > 0.0)
    return np.where(is_leader, gap, np.inf).min(axis=1, initial=np.inf)


def pool(scenarios: Iterable[Scenario]) -> tuple[dict[str, Array], int]:
    """Pool all scenarios and count them."""
    values_by_scenario = [quantities(scenario) for scenario in scenarios]
    return {
        name: np.concatenate([values[name] for values in values_by_scenario]) for name in QUANTITIES
    }, len(values_by_scenario)


def read_recordings(data: Path) -> Iterable[Scenario]:
    """Yield non-overlapping windows of all recordings that are long enough."""
    for item in survey(data).inputs:
        if item.format is None:
            continue
        for recording in find_reader(item.format).read(item.path):
            if not isinstance(recording, Recording) or len(recording.timestamps_s) < STEPS:
                continue
            try:
                for window in windows(recording, stride=STEPS):
                    yield assemble(window, CAPACITIES["large"])
            except DrivaxError as error:
                print(f"  left out: {error}")


def generate_scenarios(scenarios: int, seed: int, domain: str) -> Iterable[Scenario]:
    """Yield scenarios of the built-in world."""
    config = replace(WorldConfig(), domain=domain)
    for index in range(scenarios):
        try:
            yield assemble(generate_one(seed, index, config).recording)
        except UsageError as error:
            print(f"  left out: {error}")


def compare_distributions(recordings: dict[str, Array], world: dict[str, Array]) -> dict[str, Any]:
    """Return percentiles of both distributions, and their Kolmogorov-Smirnov distance."""
    result = {}
    for name in QUANTITIES:
        row: dict[str, Any] = {
            key: {f"p{p}": float(np.percentile(v[name], p)) for p in (5, 25, 50, 75, 95)}
            | {"n": len(v[name])}
            for key, v in (("real", recordings), ("world", world))
        }
        row["ks"] = float(np.asarray(ks_2samp(recordings[name], world[name]))[0])
        result[name] = row
    return result


def draw_figure(sources: dict[str, dict[str, Array]], out: Path) -> None:
    """Draw histograms of every quantity: the first source as an area, the others as lines.

    The outermost bins include values outside the range.
    """
    page = Figure(figsize=(9.0, 8.6), dpi=120, facecolor="white", layout="constrained")
    axes = page.subplots(3, 3).flat
    styles = [{"color": "#c6ccd3", "histtype": "stepfilled"}]
    styles += [
        {"color": colour, "histtype": "step", "linewidth": 1.8, "linestyle": dashes}
        for colour, dashes in ((BLUE, "-"), (VERMILLION, (0, (4, 1.2))))
    ]
    for axis, (name, (label, (low, high))) in zip(axes, QUANTITIES.items(), strict=False):
        edges = np.arange(low, high + 2.0, 2.0) if name == "agents" else np.linspace(low, high, 31)
        for style, (source, values) in zip(styles, sources.items(), strict=True):
            clipped_values = np.clip(values[name], low, high)
            axis.hist(
                clipped_values,
                edges,
                weights=np.full(len(clipped_values), 1.0 / len(clipped_values)),
                label=source,
                **style,
            )
        axis.set_xlabel(label, fontsize=10.5)
        axis.set_xlim(low, high)
        axis.set_ylabel("share of values" if name in FIRST_IN_ROW else "", fontsize=10.5)
        axis.tick_params(labelsize=9.5)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    handles = page.axes[0].get_legend_handles_labels()
    page.axes[len(QUANTITIES)].legend(*handles, loc="center left", frameon=False, fontsize=11.5)
    for axis in page.axes[len(QUANTITIES) :]:
        axis.axis("off")
    save_picture(page, out)


def main() -> None:
    """Measure, print a Markdown table, and draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenarios", type=int, default=256, help="per domain")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figure", type=Path, default=Path("world-resemblance.png"))
    parser.add_argument("--write", action="store_true", help=f"store {RESULT.name} and the guide's figure")
    args = parser.parse_args()
    recordings, count = pool(read_recordings(args.data))
    sources = {f"recordings ({count} windows)": recordings}
    result: dict[str, Any] = {"world": WORLD_VERSION, "windows": count, "scenarios": args.scenarios}
    for domain in sorted(DOMAINS):
        values, _ = pool(generate_scenarios(args.scenarios, args.seed, domain))
        sources[f"world, {domain}"] = values
        result[domain] = compare_distributions(recordings, values)
        print(
            f"\n{domain}\n| quantity | recordings: 5 %, median, 95 % | world | KS distance |\n|---|---|---|---|"
        )
        for name, (label, _) in QUANTITIES.items():
            row = result[domain][name]
            cells = [
                ", ".join(f"{row[key][p]:.2f}" for p in ("p5", "p50", "p95")) for key in ("real", "world")
            ]
            print(f"| {label} | {cells[0]} | {cells[1]} | {row['ks']:.2f} |")
    draw_figure(sources, FIGURE if args.write else args.figure)
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()

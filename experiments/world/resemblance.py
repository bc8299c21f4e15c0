"""Compare the built-in world with real recordings: one figure, medians, Kolmogorov-Smirnov distances.

Compares ego and every other vehicle that is always valid, within 50 m of ego on average and drives at least 5 m, in the
world and the recordings. The recordings come from a few places and do not represent any data set, so differences in
the number of agents may reflect these places.

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

from drivax.datasets.formats import reader_named, survey
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
#: Quantity: label, and the range that the figure shows.
QUANTITIES = {
    "speed": ("speed (m/s)", (0.0, 30.0)),
    "acceleration": ("acceleration (m/s2)", (-4.0, 4.0)),
    "yaw_rate": ("yaw rate (rad/s)", (-0.6, 0.6)),
    "leader_m": ("distance to the leader (m)", (0.0, 60.0)),
    "leader_s": ("time gap to the leader (s)", (0.0, 6.0)),
    "agents": ("agents within 50 m", (0.0, 80.0)),
    "nearest_m": ("distance to the nearest agent (m)", (0.0, 40.0)),
}
#: Panels that begin a row of the figure.
FIRST_IN_ROW = tuple(QUANTITIES)[::3]
#: Who drives less than this is no subject, m.
DRIVES_M = 5.0
#: Nor who is farther from ego on average: who surrounds them is not recorded in full, m.
NEAR_EGO_M = 50.0
#: A leader is this near, within this distance of the subject's axis, and heads the same way within 45 degrees.
LEADER_M, LEADER_ASIDE_M = 60.0, 1.6
#: Yaw rates and time gaps of standing cars mean nothing.
ROLLS_MPS = 2.0
#: One step in five is looked at: neighbours say the same.
EVERY = 5


def quantities(scenario: Scenario) -> dict[str, Array]:
    """Values of all compared vehicles and steps of one scenario."""
    box, velocity, valid, kind, _ = all_agents(scenario)
    subjects = np.flatnonzero(valid.all(axis=0) & (kind == AgentKind.VEHICLE))
    way = np.hypot(*np.moveaxis(np.diff(box[:, subjects, :2], axis=0), -1, 0)).sum(axis=0)
    apart = np.hypot(*np.moveaxis(box[:, subjects, :2] - box[:, :1, :2], -1, 0)).mean(axis=0)
    subjects = subjects[(subjects == 0) | ((way >= DRIVES_M) & (apart < NEAR_EGO_M))]
    parts = [_subject(row, box, velocity, valid, kind) for row in subjects]
    return {name: np.concatenate([part[name] for part in parts]) for name in QUANTITIES}


def _subject(row: int, box: Array, velocity: Array, valid: Array, kind: Array) -> dict[str, Array]:
    steps = slice(0, None, EVERY)
    heading = np.unwrap(np.arctan2(box[:, row, 3], box[:, row, 2]))
    speed = np.hypot(*velocity[:, row].T)
    slope = {"window_length": 15, "polyorder": 2, "deriv": 1, "delta": DT_S}
    acceleration, rate = savgol_filter(speed, **slope)[steps], savgol_filter(heading, **slope)[steps]
    speed, me, others = speed[steps], box[steps, row], box[steps]
    there = valid[steps].copy()
    there[:, row] = False
    apart = others[..., :2] - me[:, None, :2]
    distance = np.where(there, np.hypot(apart[..., 0], apart[..., 1]), np.inf)
    gap = _leader_gap(me, others, apart, there & (kind == AgentKind.VEHICLE))
    led, rolls, near = gap < LEADER_M, speed > ROLLS_MPS, distance.min(axis=1, initial=np.inf)
    return {
        "speed": speed,
        "acceleration": acceleration,
        "yaw_rate": rate[rolls],
        "leader_m": gap[led],
        "leader_s": gap[led & rolls] / speed[led & rolls],
        "agents": (distance < 50.0).sum(axis=1).astype(np.float64),
        "nearest_m": near[np.isfinite(near)],
    }


def _leader_gap(me: Array, others: Array, apart: Array, there: Array) -> Array:
    """Bumper-to-bumper distance to the vehicle ahead at every step, infinite without one."""
    cos, sin = me[:, None, 2], me[:, None, 3]
    ahead = apart[..., 0] * cos + apart[..., 1] * sin
    aside = np.abs(apart[..., 1] * cos - apart[..., 0] * sin)
    same = others[..., 2] * cos + others[..., 3] * sin > np.cos(np.pi / 4)
    gap = ahead - (others[..., 4] + me[:, None, 4]) / 2
    leads = there & same & (aside < LEADER_ASIDE_M) & (gap > 0.0)
    return np.where(leads, gap, np.inf).min(axis=1, initial=np.inf)


def pooled(scenarios: Iterable[Scenario]) -> tuple[dict[str, Array], int]:
    """Pool all scenarios and count them."""
    parts = [quantities(scenario) for scenario in scenarios]
    return {name: np.concatenate([part[name] for part in parts]) for name in QUANTITIES}, len(parts)


def real(data: Path) -> Iterable[Scenario]:
    """Yield windows, without overlap, of all recordings that are long enough."""
    for item in survey(data).inputs:
        if item.format is None:
            continue
        for recording in reader_named(item.format).read(item.path):
            if not isinstance(recording, Recording) or len(recording.timestamps_s) < STEPS:
                continue
            try:
                for window in windows(recording, stride=STEPS):
                    yield assemble(window, CAPACITIES["large"])
            except DrivaxError as error:
                print(f"  left out: {error}")


def world(scenarios: int, seed: int, domain: str) -> Iterable[Scenario]:
    """Yield scenarios of the built-in world."""
    config = replace(WorldConfig(), domain=domain)
    for index in range(scenarios):
        try:
            yield assemble(generate_one(seed, index, config).recording)
        except UsageError as error:
            print(f"  left out: {error}")


def compared(theirs: dict[str, Array], ours: dict[str, Array]) -> dict[str, Any]:
    """Percentiles of both distributions, and the largest difference of their distribution functions."""
    result = {}
    for name in QUANTITIES:
        row: dict[str, Any] = {
            key: {f"p{p}": float(np.percentile(v[name], p)) for p in (5, 25, 50, 75, 95)}
            | {"n": len(v[name])}
            for key, v in (("real", theirs), ("world", ours))
        }
        row["ks"] = float(np.asarray(ks_2samp(theirs[name], ours[name]))[0])
        result[name] = row
    return result


def figure(sources: dict[str, dict[str, Array]], out: Path) -> None:
    """One panel per quantity: the first source as an area, the others as lines; shares of the values per bin.

    The outermost bins hold what lies beyond as well.
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
            inside = np.clip(values[name], low, high)
            axis.hist(inside, edges, weights=np.full(len(inside), 1.0 / len(inside)), label=source, **style)
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
    recorded, count = pooled(real(args.data))
    sources = {f"recordings ({count} windows)": recorded}
    result: dict[str, Any] = {"world": WORLD_VERSION, "windows": count, "scenarios": args.scenarios}
    for domain in sorted(DOMAINS):
        values, _ = pooled(world(args.scenarios, args.seed, domain))
        sources[f"world, {domain}"] = values
        result[domain] = compared(recorded, values)
        print(
            f"\n{domain}\n| quantity | recordings: 5 %, median, 95 % | world | KS distance |\n|---|---|---|---|"
        )
        for name, (label, _) in QUANTITIES.items():
            row = result[domain][name]
            cells = [
                ", ".join(f"{row[key][p]:.2f}" for p in ("p5", "p50", "p95")) for key in ("real", "world")
            ]
            print(f"| {label} | {cells[0]} | {cells[1]} | {row['ks']:.2f} |")
    figure(sources, FIGURE if args.write else args.figure)
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()

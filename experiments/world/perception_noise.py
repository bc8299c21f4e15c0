"""Estimate jitter in tracks of real logs, for the built-in world's perception noise.

Tracks of other moving vehicles are smoothed with a Savitzky-Golay filter of 1.1 s and order 3; the residual is the
tracker's noise (and the motion that a cubic cannot follow). The filter mistakes part of correlated noise for motion, so
an AR(1) process is fitted whose residual under the same filter has the measured standard deviation and lag-1
autocorrelation (both in closed form from the filter's matrix).

Run: python -m experiments.world.perception_noise --data ../shared/data --out experiments/results/perception_noise.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from drivax.datasets.formats import find_reader, survey
from drivax.scenario.recording import Recording, Tracks
from drivax.scenario.schema import AgentKind

WINDOW, ORDER = 11, 3
#: Minimum speed at all steps of a run, m/s, and its minimum number of steps without a gap.
MOVING_MPS, RUN = 2.0, 31
#: Data sets with tracks interpolated from 2 Hz, which have no noise at 10 Hz.
INTERPOLATED = ("nuscenes",)
QUANTITIES = ("along_m", "across_m", "heading_rad", "speed_mps")

Array = np.ndarray[Any, Any]


def residual_filter(steps: int) -> Float[Array, "step step"]:
    """Return the matrix that maps a series to its smoothing residual (only inner rows are used)."""
    smooth = savgol_filter(np.eye(steps), WINDOW, ORDER, axis=0)
    return np.eye(steps) - smooth


def residual_statistics(correlation: float) -> tuple[float, float]:
    """Return the standard deviation and lag-1 autocorrelation of the residual of AR(1) noise of variance 1."""
    steps = 2 * WINDOW + 1
    rows = residual_filter(steps)[WINDOW : WINDOW + 2]
    covariance = correlation ** np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
    outer = rows @ covariance @ rows.T
    return float(np.sqrt(outer[0, 0])), float(outer[0, 1] / outer[0, 0])


def fit_noise(deviation: float, lag_one: float) -> tuple[float, float]:
    """Fit AR(1) noise to a residual: return its standard deviation and correlation (0 to 0.95 per step)."""
    grid = np.linspace(0.0, 0.95, 96)
    table = np.array([residual_statistics(value) for value in grid])
    best = int(np.argmin(np.abs(table[:, 1] - lag_one)))
    return deviation / float(table[best, 0]), float(grid[best])


def moving_runs(tracks: Tracks, ego: int) -> list[tuple[int, slice]]:
    """Return rows and steps of other vehicles that move without a gap."""
    speed = np.hypot(*np.moveaxis(tracks.velocity, -1, 0))
    is_moving = tracks.valid & (speed > MOVING_MPS) & (tracks.kind == AgentKind.VEHICLE)[:, None]
    is_moving[ego] = False
    result = []
    for row in np.flatnonzero(is_moving.any(axis=1)):
        change = np.flatnonzero(np.diff(np.concatenate(([False], is_moving[row], [False]))))
        result += [
            (int(row), slice(int(a), int(b)))
            for a, b in zip(change[::2], change[1::2], strict=True)
            if b - a >= RUN
        ]
    return result


def residuals(recording: Recording) -> dict[str, list[Array]]:
    """Return the residuals by quantity and run, without the ends."""
    tracks, result = recording.tracks, {name: [] for name in QUANTITIES}
    inner = slice(WINDOW // 2, -(WINDOW // 2))
    for row, steps in moving_runs(tracks, recording.ego):
        xy, heading = tracks.xy[row, steps], np.unwrap(tracks.heading[row, steps])
        speed = np.hypot(*tracks.velocity[row, steps].T)
        smooth = savgol_filter(heading, WINDOW, ORDER)
        xy_residual = xy - savgol_filter(xy, WINDOW, ORDER, axis=0)
        cos, sin = np.cos(smooth), np.sin(smooth)
        values = (
            xy_residual[:, 0] * cos + xy_residual[:, 1] * sin,
            xy_residual[:, 1] * cos - xy_residual[:, 0] * sin,
            heading - smooth,
            speed - savgol_filter(speed, WINDOW, ORDER),
        )
        for name, value in zip(QUANTITIES, values, strict=True):
            result[name].append(value[inner])
    return result


def summary(pieces: list[Array]) -> dict[str, float]:
    """Return median and 90th percentile of residual deviations, the median autocorrelation, and the fitted noise."""
    # Medians over runs are robust to a few tracks with swapped identities.
    deviation = float(np.median([np.std(piece) for piece in pieces]))
    lag = float(np.median([np.mean(p[1:] * p[:-1]) / max(np.mean(p * p), 1e-12) for p in pieces]))
    sigma, correlation = fit_noise(deviation, lag)
    return {
        "residual_std": deviation,
        "residual_p90": float(np.percentile([np.std(piece) for piece in pieces], 90)),
        "residual_lag1": lag,
        "noise_std": sigma,
        "noise_correlation": correlation,
    }


def measure(data: Path) -> dict[str, Any]:
    """Measure all recordings under a folder, by data set."""
    results: dict[str, dict[str, list[Array]]] = {}
    for item in survey(data).inputs:
        if item.format is None:
            continue
        for recording in find_reader(item.format).read(item.path):
            if not isinstance(recording, Recording):
                continue
            name = f"{item.format}:{recording.dataset}"
            if any(word in name for word in INTERPOLATED):
                continue
            data_set_residuals = results.setdefault(name, {quantity: [] for quantity in QUANTITIES})
            for quantity, pieces in residuals(recording).items():
                data_set_residuals[quantity] += pieces
    return {
        name: {
            "runs": len(quantities["along_m"]),
            **{quantity: summary(pieces) for quantity, pieces in quantities.items() if pieces},
        }
        for name, quantities in sorted(results.items())
    }


def main() -> None:
    """Measure, print a table, and write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("perception_noise.json"))
    args = parser.parse_args()
    result = measure(args.data)
    for name, values in result.items():
        print(f"{name}: {values['runs']} runs")
        for quantity in QUANTITIES:
            if quantity in values:
                row = values[quantity]
                print("  " + f"{quantity:<12}" + "  ".join(f"{k} {v:.4f}" for k, v in row.items()))
    args.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()

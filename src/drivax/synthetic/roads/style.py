"""Road styles: the ranges from which all families of a domain draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Numbers of lanes ahead (inward) and of opposite lanes (outward), and share, of each layout.
Layouts = tuple[tuple[int, int, float], ...]


@dataclass(frozen=True)
class RoadStyle:
    """Statistics of a domain's roads.

    Attributes:
        width_m, shoulder_m: Width of lanes, and drivable width beyond the outer ones, low and high.
        limits_mps, fast_limits_mps: Speed limits of streets and of highways; repeated ones are drawn more often.
        curvature: Factor on the curvature of streets without junctions.
        sidewalk_share, parking_share: Shares of roads with sidewalks and with bays, where they are optional.
    """

    width_m: tuple[float, float] = (3.35, 3.75)
    limits_mps: tuple[float, ...] = (11.2, 13.4, 15.6, 17.9)
    fast_limits_mps: tuple[float, ...] = (22.4, 24.6, 26.8, 29.1)
    shoulder_m: tuple[float, float] = (0.5, 1.5)
    curvature: float = 1.0
    sidewalk_share: float = 0.8
    parking_share: float = 0.3


#: Wide lanes and higher speeds.
GRID = RoadStyle()
#: Narrow lanes, low speeds, bays along most streets.
RING = RoadStyle(
    width_m=(2.9, 3.3),
    limits_mps=(8.3, 8.3, 11.1, 13.9),
    fast_limits_mps=(19.4, 22.2),
    shoulder_m=(0.25, 0.7),
    curvature=1.3,
    sidewalk_share=0.95,
    parking_share=0.7,
)


def draw_layout(rng: np.random.Generator, layouts: Layouts) -> tuple[int, int]:
    """Draw the numbers of lanes ahead and of opposite lanes."""
    ahead, back, _ = layouts[rng.choice(len(layouts), p=[share for *_, share in layouts])]
    return ahead, back

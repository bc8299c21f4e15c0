"""Domains: worlds with different statistics of roads and traffic, for studies of generalisation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivax.synthetic.roads.families import FAMILIES, RoadFamily
from drivax.synthetic.roads.network import GRID, RING, RoadStyle
from drivax.synthetic.traffic.placement import Density


@dataclass(frozen=True)
class Domain:
    """Statistics of roads and traffic in a part of the world.

    Attributes:
        name: Tag of every scenario.
        shares: Relative frequency of each road family among draws; families without one do not occur.
        pedestrians: Pedestrians per 100 m of sidewalk and per two crossings, low and high, drawn per scenario.
        parked_share: Share of occupied bays, low and high, drawn per scenario.
        double_share: Share of scenarios with a double-parked car, of those with a bay that has room for one next to it.
    """

    name: str
    style: RoadStyle
    shares: tuple[tuple[str, float], ...]
    density: Density = field(default_factory=Density)
    pedestrians: tuple[float, float] = (0.3, 2.0)
    parked_share: tuple[float, float] = (0.4, 0.9)
    double_share: float = 0.1

    @property
    def families(self) -> tuple[tuple[RoadFamily, float], ...]:
        """Families of this domain with their probabilities."""
        shares = dict(self.shares)
        frequencies = [(family, shares[family.name]) for family in FAMILIES if family.name in shares]
        total = sum(share for _, share in frequencies)
        return tuple((family, share / total) for family, share in frequencies)

    def draw_family(self, rng: np.random.Generator) -> RoadFamily:
        """Draw a family."""
        families = self.families
        return families[rng.choice(len(families), p=[share for _, share in families])][0]


#: Road family, and its relative frequency in the grid and in the ring.
_SHARES = (
    ("straight_road", 0.05, 0.05),
    ("curved_road", 0.15, 0.1),
    ("lane_drop", 0.07, 0.04),
    ("highway", 0.1, 0.0),
    ("signalised_junction", 0.16, 0.05),
    ("t_junction", 0.09, 0.13),
    ("all_way_stop", 0.07, 0.1),
    ("roundabout", 0.04, 0.2),
    ("unprotected_left", 0.09, 0.05),
    ("midblock_crosswalk", 0.06, 0.1),
    ("parked_street", 0.05, 0.13),
    ("corridor", 0.07, 0.05),
)
#: Wide lanes, lights, higher speeds; roundabouts are rare.
GRID_DOMAIN = Domain("grid", GRID, tuple((family, share) for family, share, _ in _SHARES))
#: Narrow streets, more roundabouts and signs, fewer lights, dense traffic, more cyclists, no highways.
RING_DOMAIN = Domain(
    name="ring",
    style=RING,
    shares=tuple((family, share) for family, _, share in _SHARES if share),
    density=Density(spacing_m=(14.0, 60.0), vehicles=40, cyclist_share=0.14),
    pedestrians=(0.5, 3.0),
    parked_share=(0.6, 1.0),
    double_share=0.25,
)
DOMAINS: dict[str, Domain] = {domain.name: domain for domain in (GRID_DOMAIN, RING_DOMAIN)}

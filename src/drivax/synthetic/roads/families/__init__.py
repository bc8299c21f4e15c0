"""Road families: frozen configurations with ``build(rng, style) -> RoadNetwork``."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from drivax.synthetic.roads.families.junctions import (
    AllWayStop,
    Corridor,
    SignalisedJunction,
    TJunction,
    UnprotectedLeft,
)
from drivax.synthetic.roads.families.roundabout import Roundabout
from drivax.synthetic.roads.families.streets import (
    STRAIGHT_ROAD,
    CurvedRoad,
    Highway,
    LaneDrop,
    MidblockCrosswalk,
    ParkedStreet,
)
from drivax.synthetic.roads.network import GRID, RoadNetwork, RoadStyle


@runtime_checkable
class RoadFamily(Protocol):
    """Kind of road, from which random examples are drawn."""

    @property
    def name(self) -> str:
        """Short name, part of scenario ids."""
        ...

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw an example."""
        ...


#: All families; a new one occurs only with a share in a domain (``synthetic.domains``).
FAMILIES: tuple[RoadFamily, ...] = (
    CurvedRoad(),
    SignalisedJunction(),
    TJunction(),
    AllWayStop(),
    UnprotectedLeft(),
    Corridor(),
    STRAIGHT_ROAD,
    LaneDrop(),
    Highway(),
    Roundabout(),
    MidblockCrosswalk(),
    ParkedStreet(),
)

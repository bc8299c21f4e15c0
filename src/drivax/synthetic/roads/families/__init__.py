"""Families of roads: each is a frozen configuration with ``build(rng, style) -> RoadNetwork``."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from drivax.synthetic.roads.families.all_way_stop import AllWayStop
from drivax.synthetic.roads.families.corridor import Corridor
from drivax.synthetic.roads.families.curved_road import STRAIGHT_ROAD, CurvedRoad
from drivax.synthetic.roads.families.highway import Highway
from drivax.synthetic.roads.families.lane_drop import LaneDrop
from drivax.synthetic.roads.families.midblock_crosswalk import MidblockCrosswalk
from drivax.synthetic.roads.families.parked_street import ParkedStreet
from drivax.synthetic.roads.families.roundabout import Roundabout
from drivax.synthetic.roads.families.signalised_junction import SignalisedJunction
from drivax.synthetic.roads.families.t_junction import TJunction
from drivax.synthetic.roads.families.unprotected_left import UnprotectedLeft
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle


@runtime_checkable
class RoadFamily(Protocol):
    """A kind of road of which chance draws examples."""

    @property
    def name(self) -> str:
        """Short name, part of scenario ids."""
        ...

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws one example."""
        ...


#: The families of the world; a new one is a file here and an entry in this tuple.
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

__all__ = [
    "FAMILIES",
    "STRAIGHT_ROAD",
    "AllWayStop",
    "Corridor",
    "CurvedRoad",
    "Highway",
    "LaneDrop",
    "MidblockCrosswalk",
    "ParkedStreet",
    "RoadFamily",
    "Roundabout",
    "SignalisedJunction",
    "TJunction",
    "UnprotectedLeft",
]

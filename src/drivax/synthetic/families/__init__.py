"""Families of roads: each is a frozen configuration with ``build(rng) -> RoadNetwork``."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from drivax.synthetic.families.curved_road import CurvedRoad
from drivax.synthetic.families.signalised_junction import SignalisedJunction
from drivax.synthetic.roads import RoadNetwork
from drivax.synthetic.style import GRID, RoadStyle


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
FAMILIES: tuple[RoadFamily, ...] = (CurvedRoad(), SignalisedJunction())

__all__ = ["FAMILIES", "CurvedRoad", "RoadFamily", "SignalisedJunction"]

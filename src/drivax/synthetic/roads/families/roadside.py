"""What lies beside and across the lanes of junctions: kerbs, sidewalks, markings and crossings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import Curve, connected, joined
from drivax.synthetic.roads.draft import Draft, ring
from drivax.synthetic.roads.families.junction import Approach, CrossSection, Geometry, Site
from drivax.synthetic.roads.network import Crossing, Line
from drivax.synthetic.roads.style import RoadStyle

#: An approach by the number of its site and its own.
Place = tuple[int, int]


def outline(draft: Draft, sites: Sequence[Site], links: dict[Place, Place], walk_m: float | None) -> None:
    """Draws the one boundary around all sites, counter-clockwise, and sidewalks along it.

    Args:
        draft: Where to draw.
        sites: The junctions; every site but the first is linked to an earlier one, without circles.
        links: Which approaches are two ends of the same street, both ways.
        walk_m: Distance of the sidewalks from the edge; None: there are none.
    """
    first = next((0, i) for i in range(len(sites[0].approaches)) if (0, i) not in links)
    kerbs, at = [], first
    while not kerbs or at != first:
        kerb, at = _kerb_between_ends(sites, links, at)
        kerbs.append(kerb)
    draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*kerbs)))
    if walk_m is not None:
        draft.walks += [kerb.shifted(-walk_m) for kerb in kerbs]


def _kerb_between_ends(sites: Sequence[Site], links: dict[Place, Place], begin: Place) -> tuple[Curve, Place]:
    """The edge from one end of the map to the next: in along an arm's left, round the corners, out along a right."""

    def approach(place: Place) -> Approach:
        return sites[place[0]].approaches[place[1]]

    pieces = [approach(begin).side.shifted(approach(begin).arm.street.left_m).reversed()]
    here = begin
    while True:
        after = (here[0], (here[1] + 1) % len(sites[here[0]].approaches))
        side = approach(after).side.shifted(-approach(after).arm.street.right_m)
        pieces += [connected(pieces[-1].end, side.start), side]
        if after not in links:
            return joined(*pieces), after
        here = links[after]


def paint(draft: Draft, street: CrossSection, middle: Curve) -> None:
    """Markings along a street."""
    draft.mark(RoadKind.LINE_SOLID_DOUBLE_YELLOW, middle)
    for side, count in ((1.0, street.inward), (-1.0, street.outward)):
        for j in range(1, count + 1):
            kind = RoadKind.LINE_SOLID_SINGLE_WHITE if j == count else RoadKind.LINE_BROKEN_SINGLE_WHITE
            draft.mark(kind, middle.shifted(side * (street.gap_m / 2 + j * street.width_m)))


def add_crossings(draft: Draft, site: Site) -> None:
    """Lets people cross every approach at its mouth: on a crosswalk where it is marked, else without."""
    for i, approach in enumerate(site.approaches):
        street = approach.arm.street
        near, far = (approach.arm.base.ahead(approach.mouth_m + metres) for metres in street.crossing_m)
        if street.marked:
            corners = [
                near.aside(street.left_m),
                far.aside(street.left_m),
                far.aside(-street.right_m),
                near.aside(-street.right_m),
            ]
            draft.crosswalks.append(Line(RoadKind.CROSSWALK, np.array([[p.x, p.y] for p in corners])))
        width = street.crossing_m[1] - street.crossing_m[0]
        middle = near.ahead(width / 2)
        axis = np.array([[p.x, p.y] for p in (middle.aside(street.left_m), middle.aside(-street.right_m))])
        draft.crossings.append(Crossing(axis, width, _crossed(draft, site, i), street.marked))


def _crossed(draft: Draft, site: Site, i: int) -> tuple[tuple[int, float], ...]:
    """The connectors that the crossing of an approach crosses, and where on each, m."""
    street = site.approaches[i].arm.street
    inside = street.stop_line_m - sum(street.crossing_m) / 2
    entering = [(move.lane, inside) for move in site.moves if move.arm == i]
    leaving = [(move.lane, draft.lanes[move.lane].length_m - inside) for move in site.moves if move.to == i]
    return (*entering, *leaving)


def draw_sidewalk_m(rng: np.random.Generator, style: RoadStyle, geometry: Geometry) -> float | None:
    """How far from the edge the sidewalks are, or None where there are none."""
    distance = float(rng.uniform(*geometry.walk_m))
    return distance if rng.random() < style.walk_share else None


def draw_surroundings(draft: Draft, site: Site, walk_m: float | None) -> None:
    """Edges, sidewalks, markings and crossings of a junction that stands alone."""
    outline(draft, (site,), {}, walk_m)
    for approach in site.approaches:
        paint(draft, approach.arm.street, approach.middle)
    add_crossings(draft, site)

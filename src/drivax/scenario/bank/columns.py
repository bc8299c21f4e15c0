"""Columns of the arrays in a scenario bank, by name."""

from __future__ import annotations

#: Arc length of stop lines that are not on the route.
NEVER_M = 1e6


class AgentColumn:
    """Columns of ``ScenarioBank.agents`` and ``parked``: pose, velocity in m/s, and whether the agent is observed.

    Parked agents count as observed here; ``ScenarioBank.parked_when`` has the steps.
    """

    X, Y, Z, COS, SIN, VX, VY, VALID = range(8)
    XY = slice(X, Z)
    HEADING = slice(COS, VX)
    VELOCITY = slice(VX, VALID)


class SizeColumn:
    """Columns of ``ScenarioBank.agent_box``: size in m, and ``AgentKind``."""

    LENGTH, WIDTH, HEIGHT, KIND = range(4)
    FOOTPRINT = slice(LENGTH, HEIGHT)


class RouteColumn:
    """Columns of ``ScenarioBank.routes``; the limit in m/s."""

    X, Y, Z, COS, SIN, LIMIT, LANE = range(7)
    XY = slice(X, Z)
    HEADING = slice(COS, LIMIT)


class EdgeRow:
    """Rows of ``ScenarioBank.edges``: both ends and the mean height of a segment."""

    X_A, Y_A, X_B, Y_B, Z = range(5)
    A = slice(X_A, X_B)
    B = slice(X_B, Z)


class LaneRow:
    """Rows of ``ScenarioBank.lanes``: those of :class:`EdgeRow`, half width, limit in m/s (-1 unknown), and lane index.

    The limit of a connector is the highest of the lanes that it joins, if known. The index is raised by 2^-(k+1) on
    lanes of the corridor of the k-th ego, from k = 0 on (the lanes of its route and their same-direction neighbours).
    """

    X_A, Y_A, X_B, Y_B, Z, HALF_WIDTH, LIMIT, LANE = range(8)


class LightRow:
    """Rows of ``ScenarioBank.light_line``.

    Centre of the stop line, direction of its lane, half its length, height, direction at the end of that lane, whether
    that end turns right by more than 45 degrees, and arc length along the route of the recorded ego (``NEVER_M`` on
    other lanes); rows for the routes of further egos follow.
    """

    X, Y, COS, SIN, HALF, Z, EXIT_COS, EXIT_SIN, RIGHT, ARC = range(10)
    XY = slice(X, COS)
    HEADING = slice(COS, HALF)


class RoadColumn:
    """Columns of ``ScenarioBank.road``: centre, direction and length of a piece, ``RoadLayer``, limit (-1 unknown)."""

    X, Y, COS, SIN, LENGTH, LAYER, LIMIT = range(7)
    XY = slice(X, COS)
    DIRECTION = slice(COS, LENGTH)


class RoadLayer:
    """Layers of observed pieces of road; unused rows have layer ``NONE``."""

    LANE, EDGE, AREA, NONE = range(4)


class StrandColumn:
    """Columns of ``ScenarioBank.lane_strands``; -1 for no strand, 1e6 for no point.

    The strand of a lane, the strands next to that lane on the left and the right, the strand that its strand merges
    onto, and the point where it does.
    """

    STRAND, LEFT, RIGHT, ONTO, END_X, END_Y = range(6)
    END = slice(END_X, END_Y + 1)

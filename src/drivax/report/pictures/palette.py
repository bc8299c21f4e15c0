"""Colours of maps, agents and lights, the same in pictures and in the player.

The hues are those of Okabe and Ito, Color Universal Design, 2008, told apart with any kind of colour vision; what
matters has a shape of its own besides (the ego's arrow, crosses at failures, thick bars for red lights).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

from drivax.scenario.schema import AgentKind, LightState, RoadKind

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"

#: Colours of lines in charts, in order.
SERIES = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY)


@dataclass(frozen=True)
class Stroke:
    """How a line of a chart is drawn.

    Attributes:
        colour: Of the line.
        dash: Lengths of dash and gap, as SVG has them; empty for an unbroken line.
    """

    colour: str
    dash: str = ""

    @property
    def svg(self) -> str:
        """Attributes of an element of SVG."""
        return f'stroke="{self.colour}"' + (f' stroke-dasharray="{self.dash}"' if self.dash else "")

    @property
    def key(self) -> str:
        """CSS of the background of its key in a legend."""
        if not self.dash:
            return self.colour
        on, off = map(int, self.dash.split())
        return f"repeating-linear-gradient(90deg,{self.colour} 0 {on}px,transparent {on}px {on + off}px)"


#: Lines of charts, in order: where colours run out they come again dashed, then dotted.
STROKES = tuple(Stroke(colour, dash) for dash in ("", "6 3", "2 3") for colour in SERIES)


def stroke(place: int) -> Stroke:
    """How the line at a place is drawn."""
    return STROKES[place % len(STROKES)]


LIGHT = MappingProxyType(
    {
        "ground": "#f4f5f7", "ink": "#1b1f24", "edge": "#3b424b", "lane": "#b9c2cd", "line": "#9aa5b1",
        "bike": "#8fc7b5", "crosswalk": "#dfe4ea", "outline": "#1b1f24", "ego": PURPLE, "route": PURPLE, "goal": PURPLE,
        "log": "#5b6570", "vehicle": SKY, "pedestrian": YELLOW, "cyclist": ORANGE, "other": BLUE,
        "parked": "#c6ccd3", "red": VERMILLION, "amber": ORANGE, "green": GREEN, "unknown": "#8b949e",
        "stop": VERMILLION, "mark": VERMILLION,
    }
)  # fmt: skip
DARK = MappingProxyType(
    {
        "ground": "#15191e", "ink": "#e8ecf0", "edge": "#aab4bf", "lane": "#3d4651", "line": "#56616d",
        "bike": "#2c5c4e", "crosswalk": "#262d35", "outline": "#0b0d10", "ego": PURPLE, "route": PURPLE, "goal": PURPLE,
        "log": "#9aa5b1", "vehicle": SKY, "pedestrian": YELLOW, "cyclist": ORANGE, "other": BLUE,
        "parked": "#4a535d", "red": VERMILLION, "amber": ORANGE, "green": GREEN, "unknown": "#8b949e",
        "stop": VERMILLION, "mark": VERMILLION,
    }
)  # fmt: skip
THEMES = MappingProxyType({"light": LIGHT, "dark": DARK})

#: What the legend lists: name of the colour and words.
LEGEND = (
    ("ego", "ego"), ("log", "ego as logged"), ("route", "route"), ("goal", "goal"), ("vehicle", "vehicle"),
    ("parked", "standing still"), ("pedestrian", "pedestrian"), ("cyclist", "cyclist"), ("other", "other"),
    ("red", "red light"), ("amber", "amber"), ("green", "green"), ("unknown", "light not known"), ("stop", "stop sign"),
    ("mark", "first collision, off-road or red light; the planner's crash"),
)  # fmt: skip


def agent_colour(kind: int) -> str:
    """Name of the colour of an agent of this kind."""
    names = {
        AgentKind.VEHICLE: "vehicle",
        AgentKind.PEDESTRIAN: "pedestrian",
        AgentKind.CYCLIST: "cyclist",
        AgentKind.STATIC: "parked",
    }
    return names.get(AgentKind(kind), "other")


def light_colour(state: int) -> str:
    """Name of the colour of a light in this state; a light that nobody observed has the unknown one."""
    names = {
        LightState.ARROW_STOP: "red",
        LightState.STOP: "red",
        LightState.FLASHING_STOP: "red",
        LightState.ARROW_CAUTION: "amber",
        LightState.CAUTION: "amber",
        LightState.FLASHING_CAUTION: "amber",
        LightState.ARROW_GO: "green",
        LightState.GO: "green",
    }
    return names.get(LightState(state), "unknown")


def road_layer(kind: int) -> str:
    """Layer in which a map feature of this kind is drawn: lane, bike, line, edge, crosswalk or other."""
    road = RoadKind(kind)
    if road in (RoadKind.LANE_UNDEFINED, RoadKind.LANE_FREEWAY, RoadKind.LANE_SURFACE):
        return "lane"
    if road is RoadKind.LANE_BIKE:
        return "bike"
    if road in (RoadKind.EDGE_UNKNOWN, RoadKind.EDGE_BOUNDARY, RoadKind.EDGE_MEDIAN):
        return "edge"
    if road in (RoadKind.CROSSWALK, RoadKind.SPEED_BUMP, RoadKind.DRIVEWAY):
        return "crosswalk"
    return "line"

"""Colours of maps, agents and lights, the same in pictures and in the player.

The hues are those of Okabe and Ito, Color Universal Design, 2008, which differ with any kind of colour vision;
important elements also differ in shape (the ego's arrow, crosses at failures, thick bars for red lights).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from drivax.errors import UsageError
from drivax.scenario.schema import AgentKind, LightState, RoadKind

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"

#: Colours of lines in charts, in order.
SERIES = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY)


@dataclass(frozen=True)
class Stroke:
    """Style of a line in a chart; ``dash`` has the lengths of dash and gap as in SVG, "" for a solid line."""

    colour: str
    dash: str = ""

    @property
    def svg(self) -> str:
        """Attributes of an SVG element."""
        return f'stroke="{self.colour}"' + (f' stroke-dasharray="{self.dash}"' if self.dash else "")

    @property
    def key(self) -> str:
        """CSS background of the line's key in a legend."""
        if not self.dash:
            return self.colour
        on, off = map(int, self.dash.split())
        return f"repeating-linear-gradient(90deg,{self.colour} 0 {on}px,transparent {on}px {on + off}px)"


#: Lines of charts, in order: solid, then dashed, then dotted.
STROKES = tuple(Stroke(colour, dash) for dash in ("", "6 3", "2 3") for colour in SERIES)


def stroke(index: int) -> Stroke:
    """Return the style of a line by its index; styles repeat after the last."""
    return STROKES[index % len(STROKES)]


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
    LIGHT | {
        "ground": "#15191e", "ink": "#e8ecf0", "edge": "#aab4bf", "lane": "#3d4651", "line": "#56616d",
        "bike": "#2c5c4e", "crosswalk": "#262d35", "outline": "#0b0d10", "log": "#9aa5b1", "parked": "#4a535d",
    }
)  # fmt: skip
THEMES = MappingProxyType({"light": LIGHT, "dark": DARK})


def theme_colours(name: str) -> Mapping[str, str]:
    """Return the colours of a theme.

    Raises:
        UsageError: There is no such theme.
    """
    if name not in THEMES:
        raise UsageError(f"unknown theme {name!r}", cure=f"use {' or '.join(THEMES)}")
    return THEMES[name]


#: The legend: name of the colour and words.
LEGEND = (
    ("ego", "ego"), ("log", "ego as logged"), ("route", "route"), ("goal", "goal"), ("vehicle", "vehicle"),
    ("parked", "standing still"), ("pedestrian", "pedestrian"), ("cyclist", "cyclist"), ("other", "other"),
    ("red", "red light"), ("amber", "amber"), ("green", "green"), ("unknown", "light not known"), ("stop", "stop sign"),
    ("mark", "first collision, off-road or red light; the planner's crash"),
)  # fmt: skip


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a hex colour, 0 to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


_AGENTS = {
    AgentKind.VEHICLE: "vehicle", AgentKind.PEDESTRIAN: "pedestrian", AgentKind.CYCLIST: "cyclist",
    AgentKind.STATIC: "parked",
}  # fmt: skip
_LIGHTS = {
    LightState.ARROW_STOP: "red", LightState.STOP: "red", LightState.FLASHING_STOP: "red",
    LightState.ARROW_CAUTION: "amber", LightState.CAUTION: "amber", LightState.FLASHING_CAUTION: "amber",
    LightState.ARROW_GO: "green", LightState.GO: "green",
}  # fmt: skip
_ROADS = {
    RoadKind.LANE_UNDEFINED: "lane", RoadKind.LANE_FREEWAY: "lane", RoadKind.LANE_SURFACE: "lane",
    RoadKind.LANE_BIKE: "bike", RoadKind.EDGE_UNKNOWN: "edge", RoadKind.EDGE_BOUNDARY: "edge",
    RoadKind.EDGE_MEDIAN: "edge", RoadKind.CROSSWALK: "crosswalk", RoadKind.SPEED_BUMP: "crosswalk",
    RoadKind.DRIVEWAY: "crosswalk",
}  # fmt: skip


def agent_colour(kind: int) -> str:
    """Return the colour name of an agent of this kind."""
    return _AGENTS.get(AgentKind(kind), "other")


def light_colour(state: int) -> str:
    """Return the colour name of a light in this state, ``unknown`` for an unobserved light."""
    return _LIGHTS.get(LightState(state), "unknown")


def road_layer(kind: int) -> str:
    """Return the layer of a map feature of this kind: lane, bike, line, edge or crosswalk."""
    return _ROADS.get(RoadKind(kind), "line")

"""Frames of a video: one scenario from above, drawn straight into pixels, a few milliseconds each.

The same things in the same colours as the player's. matplotlib's rasteriser is driven directly: a figure with artists
takes ten times as long per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.report.pictures.episode import Drive, surroundings
from drivax.report.pictures.palette import LEGEND, THEMES, agent_colour, light_colour
from drivax.report.pictures.roads import light_rows, road_lines, route, stop_signs
from drivax.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.path import Path
    from matplotlib.transforms import Affine2D

Array = np.ndarray[Any, Any]
#: Red, green, blue and an alpha that says nothing: copied whole it is copied fast.
Picture = UInt8[Array, "_ _ 4"]
_EVENTS = {
    "collision": "collision",
    "offroad": "off-road",
    "red_light": "red light",
    "crashed": "planner crashed",
}
_ROAD_WIDTHS = {"lane": 1.0, "bike": 1.0, "line": 1.0, "edge": 1.8}
_LIGHT_WIDTHS = {"red": 5.0, "amber": 4.0, "green": 2.5, "unknown": 2.0}
#: Metres from one side of the shorter edge of a picture to the other.
VIEW_M = 70.0
_BAR, _LINE = 30, 22


class Canvas:
    """Pixels to draw on: shapes in metres under a camera, texts and bars in pixels from the upper left corner.

    Args:
        width: Pixels.
        height: Pixels.
        theme: ``light`` or ``dark``.

    Raises:
        UsageError: matplotlib is not installed.
    """

    def __init__(self, width: int, height: int, theme: str) -> None:
        try:
            from matplotlib.backends.backend_agg import RendererAgg
            from matplotlib.font_manager import FontProperties
            from matplotlib.path import Path
            from matplotlib.transforms import Affine2D
        except ModuleNotFoundError as error:
            raise UsageError("matplotlib is not installed", cure="pip install 'drivax[show]'") from error
        # At 72 dots per inch a point of matplotlib is a pixel.
        self._agg = RendererAgg(width, height, 72)
        self._path, self._affine, self._font = Path, Affine2D, FontProperties
        self.width, self.height, self.colours = width, height, THEMES[theme]
        self._camera: Affine2D = Affine2D()

    def clear(self, colour: str = "ground") -> None:
        """Paints everything over."""
        pixel = np.array([*(int(self.colours[colour][at : at + 2], 16) for at in (1, 3, 5)), 255], np.uint8)
        np.asarray(self._agg.buffer_rgba()).view(np.uint32).fill(pixel.view(np.uint32)[0])

    def look(self, x: float, y: float, scale: float) -> None:
        """Puts a point (metres) into the middle, at so many pixels per metre."""
        camera = self._affine().translate(-x, -y).scale(scale)
        self._camera = camera.translate(self.width / 2, self.height / 2)

    def compound(self, lines: Sequence[Array]) -> Path | None:
        """Lines as one path, which is drawn faster than its parts; None of nothing."""
        return self._path.make_compound_path(*[self._path(line) for line in lines]) if lines else None

    def draw(
        self, shape: Any, line: str | None, width: float = 1.0, fill: str | None = None, dash: Any = None
    ) -> None:
        """Draws points ``[n, 2]`` or a path, metres.

        Args:
            shape: What to draw; None is nothing.
            line: Colour of its outline, None for none.
            width: Of the outline, pixels.
            fill: Colour of its inside.
            dash: Lengths of dashes and gaps, pixels.
        """
        if shape is None or len(shape) == 0:
            return
        path = shape if isinstance(shape, self._path) else self._path(shape)
        pen = self._agg.new_gc()
        pen.set_linewidth(width if line else 0.0)
        pen.set_foreground(self.colours[line or fill or "ink"])
        pen.set_capstyle("round")
        pen.set_joinstyle("round")
        if dash:
            pen.set_dashes(0, dash)
        self._agg.draw_path(pen, path, self._camera, self._rgb(fill) if fill else None)

    def text(
        self, x: float, y: float, words: str, size: float = 13.0, colour: str = "ink", right: bool = False
    ) -> float:
        """Writes one line with its base at a place in pixels, to the right or left of it; returns its width."""
        font, pen = self._font(size=size), self._agg.new_gc()
        pen.set_foreground(self.colours[colour])
        width = float(self._agg.get_text_width_height_descent(words, font, ismath=False)[0])
        self._agg.draw_text(pen, x - width if right else x, y, words, font, 0)
        return width

    def ring(self, x: float, y: float, radius: float, line: str | None, fill: str | None = None) -> None:
        """Draws a circle in pixels, 2 pixels wide or filled."""
        self._flat(_ring(np.array((x, y)), radius), line, 2.0, fill)

    def bar(self, x: float, y: float, width: float, height: float, fill: str) -> None:
        """Fills a rectangle in pixels, its upper left corner given."""
        self._flat(
            np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)]), None, 0.0, fill
        )

    def _flat(self, shape: Array, line: str | None, width: float, fill: str | None) -> None:
        camera, self._camera = self._camera, self._affine().scale(1, -1).translate(0, self.height)
        self.draw(shape, line, width, fill)
        self._camera = camera

    def pixels(self) -> Picture:
        """A copy of what was drawn."""
        return np.asarray(self._agg.buffer_rgba()).copy()

    def _rgb(self, name: str) -> tuple[float, float, float]:
        red, green, blue = (int(self.colours[name][at : at + 2], 16) / 255 for at in (1, 3, 5))
        return red, green, blue


class Scenery:
    """What is drawn of a scenario at every step, prepared once.

    Args:
        canvas: Where it will be drawn.
        scenario: The scenario.
        drives: What will be looked at; the map far from all of them is left out.
    """

    def __init__(self, canvas: Canvas, scenario: Scenario, drives: Sequence[Drive]) -> None:
        self.canvas, self.scenario = canvas, scenario
        layers = road_lines(scenario, surroundings(scenario, drives))
        self._layers = {name: canvas.compound(lines) for name, lines in layers.items()}
        self._route, self._stops = route(scenario), stop_signs(scenario)
        self._lights = light_rows(scenario)
        kinds = [agent_colour(int(kind)) for kind in scenario.agent_kind]
        parked = [agent_colour(int(kind)) for kind in scenario.parked_kind]
        self._kinds = kinds, ["parked" if kind == "vehicle" else kind for kind in parked]

    def draw(self, step: int, middle: tuple[float, float]) -> None:
        """Draws map, route, lights and everybody but ego at a step, as far as seen around the middle."""
        canvas, scenario = self.canvas, self.scenario
        canvas.draw(self._layers["crosswalk"], None, fill="crosswalk")
        for name, width in _ROAD_WIDTHS.items():
            canvas.draw(self._layers[name], name, width)
        for sign in self._stops:
            canvas.draw(_ring(sign, 0.9), None, fill="stop")
        canvas.draw(self._route, "route", 2.0, dash=(7.0, 5.0))
        if len(self._route):
            canvas.draw(_ring(np.asarray(scenario.goal_xy), 2.0), "goal", 2.0)
        for row in self._lights:
            if (state := int(scenario.light_state[step, row])) >= 0:
                name = light_colour(state)
                canvas.draw(scenario.light_line[row].reshape(2, 2), name, _LIGHT_WIDTHS[name])
        moving = scenario.agent_valid[step].copy()
        moving[0] = False
        kinds, still = self._kinds
        groups = (
            (
                scenario.parked_xy,
                scenario.parked_heading,
                scenario.parked_size,
                still,
                scenario.parked_valid[step],
            ),
            (scenario.agent_xy[step], scenario.agent_heading[step], scenario.agent_size, kinds, moving),
        )
        for xy, heading, size, names, valid in groups:
            near = valid & (np.abs(xy - middle).max(axis=-1) < VIEW_M)
            for row in np.flatnonzero(near):
                canvas.draw(_box(xy[row], heading[row], size[row]), "outline", 0.8, fill=names[row])


def draw_frame(scenery: Scenery, drive: Drive, step: int, dt_s: float) -> Picture:
    """One planner's drive at a step, with its name, speed, time and what went wrong so far."""
    canvas, scenario = scenery.canvas, scenery.scenario
    canvas.clear()
    scale = (min(canvas.width, canvas.height) - _BAR) / VIEW_M
    x, y = _middle(scenario, drive, step)
    canvas.look(x, y + _BAR / 2 / scale, scale)
    scenery.draw(step, (x, y))
    _draw_ego(canvas, scenario, drive, step, scale)
    happened = [name for name, at in drive.events.items() if 0 <= at <= step and name in _EVENTS]
    canvas.bar(0, 0, canvas.width, _BAR, "crosswalk")
    written = canvas.text(10, 20, drive.planner, 14)
    canvas.text(20 + written, 20, drive.outcome, 12, "mark" if drive.outcome != "success" else "ink")
    gone = not np.isfinite(drive.ego[step]).all()
    now = "gone" if gone else f"{drive.ego[step, 3]:.1f} m/s"
    canvas.text(canvas.width - 10, 20, f"{now}   {step * dt_s:.1f} s", 12, right=True)
    for row, name in enumerate(happened):
        words = f"✕ {_EVENTS[name]} at {drive.events[name] * dt_s:.1f} s"
        canvas.text(10, _BAR + 18 + 16 * row, words, 12, "mark")
    _scale_bar(canvas, scale)
    return canvas.pixels()


def legend_strip(width: int, theme: str) -> Picture:
    """The legend, as wide as a picture and as high as it has to be (an even number of pixels)."""
    places, x, y = [], 10.0, 0
    for name, words in LEGEND:
        length = 34 + 7.0 * len(words)
        if x + length > width - 10:
            x, y = 10.0, y + _LINE
        places.append((x, y, name, words))
        x += length
    canvas = Canvas(width, (y + _LINE + 10) // 2 * 2, theme)
    canvas.clear()
    for x, y, name, words in places:
        middle = y + 5 + _LINE / 2
        if name == "mark":
            canvas.text(x + 3, middle + 5, "✕", 14, name)
        elif name in ("route", "log"):
            for dash in (0, 8):
                canvas.bar(x + dash, middle - 1.5, 6, 3, name)
        elif name == "stop":
            canvas.ring(x + 8, middle, 5, None, fill=name)
        elif name == "goal":
            canvas.ring(x + 8, middle, 6, name)
        elif name in _LIGHT_WIDTHS:
            canvas.bar(x + 5, middle - 7, 5, 14, name)
        else:
            canvas.bar(x, middle - 5, 16, 10, "outline")
            canvas.bar(x + 1, middle - 4, 14, 8, name)
        canvas.text(x + 21, middle + 4, words, 11)
    return canvas.pixels()


def _middle(scenario: Scenario, drive: Drive, step: int) -> tuple[float, float]:
    """Where the camera looks: at ego, or where it was last."""
    known = np.flatnonzero(np.isfinite(drive.ego[: step + 1]).all(axis=1))
    point = drive.ego[known[-1], :2] if known.size else scenario.agent_xy[step, 0]
    return float(point[0]), float(point[1])


def _draw_ego(canvas: Canvas, scenario: Scenario, drive: Drive, step: int, scale: float) -> None:
    size, path = scenario.agent_size[0], drive.ego[: step + 1]
    canvas.draw(path[np.isfinite(path).all(axis=1), :2], "ego", 2.0)
    if scenario.agent_valid[step, 0]:
        logged = _box(scenario.agent_xy[step, 0], scenario.agent_heading[step, 0], size)
        canvas.draw(logged, "log", 1.4, dash=(4.0, 3.0))
    if np.isfinite(path[-1]).all():
        x, y, heading, _ = path[-1]
        canvas.draw(_box((x, y), heading, size), "ink", 1.4, fill="ego")
        ahead = np.array((np.cos(heading), np.sin(heading)))
        left = np.array((-ahead[1], ahead[0]))
        tip, base, side = 0.38 * size[0] * ahead, 0.05 * size[0] * ahead, 0.32 * size[1] * left
        canvas.draw(np.array((x, y)) + np.array((tip, base + side, base - side)), None, fill="outline")
    for at in drive.events.values():
        if 0 <= at <= step and np.isfinite(drive.ego[at]).all():
            for turn in (-1, 1):
                arm = np.array((9.0, turn * 9.0)) / scale
                for colour, width in (("ground", 7.0), ("mark", 3.5)):
                    canvas.draw(np.array((drive.ego[at, :2] - arm, drive.ego[at, :2] + arm)), colour, width)


def _scale_bar(canvas: Canvas, scale: float) -> None:
    length = next(nice for nice in (5, 10, 20, 50, 100) if nice * scale >= 45 or nice == 100)
    base = canvas.height - 12
    canvas.bar(6, base - 22, length * scale + 12, 28, "ground")
    canvas.bar(12, base, length * scale, 2, "ink")
    for x in (12.0, 10 + length * scale):
        canvas.bar(x, base - 6, 2, 8, "ink")
    canvas.text(18, base - 5, f"{length} m", 12)


def _box(xy: Any, heading: Any, size: Any) -> Float[Array, "5 2"]:
    shape = corners(np.array((xy[0], xy[1], np.cos(heading), np.sin(heading), size[0], size[1])))
    return np.concatenate((shape, shape[:1]))


def _ring(xy: Array, radius_m: float) -> Float[Array, "25 2"]:
    angle = np.linspace(0.0, 2 * np.pi, 25)
    return xy + radius_m * np.column_stack((np.cos(angle), np.sin(angle)))

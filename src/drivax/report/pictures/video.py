"""Rollouts as mp4 files, of one planner or of all side by side.

matplotlib's rasteriser draws frames directly: a figure with artists takes ten times as long.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from drivax.errors import UsageError, did_you_mean, explain_missing_package
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import atomic_write, check_output, inside
from drivax.report.episodes import EpisodeGroup, EvaluatedSet, rank_scenarios, rollouts_of
from drivax.report.pictures.drawing import (
    EVENT_WORDS,
    LIGHTS,
    Drawing,
    Rollout,
    Shape,
    replace_traffic,
    ring,
    surroundings,
)
from drivax.report.pictures.palette import LEGEND, rgb, theme_colours
from drivax.report.runs import read_evaluations
from drivax.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.transforms import Affine2D

#: Side of a picture of one planner, alone and next to others, pixels.
ALONE, SIDE_BY_SIDE = 720, 480
#: Maximum number of pictures in a row.
_MAX_COLUMNS = 3


def write_videos(
    runs: Sequence[Path], out: Path, which: str, side_by_side: bool = False, data: Path | None = None,
    theme: str = "light", overwrite: bool = False, progress: Callable[[int, int], None] | None = None,
) -> list[Path]:  # fmt: skip
    """Write episodes of evaluation runs as mp4 files that play in real time; return the files, worst episode first.

    Args:
        runs: Run folders; the last evaluation is the policy, whose episodes are ranked.
        out: Folder for the files.
        which: ``worst:N``, ``all``, or the id of a scenario.
        side_by_side: Draw every comparable run with an episode of the scenario in one picture, not only the policy.
        data: Path of the policy's scenario set, if it has moved.
        theme: ``light`` or ``dark``.
        overwrite: Replace existing files.
        progress: Called with (done, total) after every file.

    Raises:
        DataError: A run folder or the scenario set is missing or damaged, the set is not the evaluated one, or a file
            in ``out`` is a symbolic link.
        UsageError: A file exists without ``overwrite``, ``which`` or the theme is invalid, the scenario has no episode,
            or a package is not installed.
    """
    evaluations = read_evaluations(runs)
    groups = _select_episodes(evaluations, which)
    if not side_by_side:
        evaluations = evaluations[-1:]
        groups = [replace(group, rows=group.rows[-1:]) for group in groups]
    files = _files(out, groups, ranked=len(groups) > 1 or which == "all" or which.startswith("worst:"))
    for file in files:
        check_output(file, overwrite)
    scenarios = EvaluatedSet(evaluations[-1], data)
    for done, (file, group) in enumerate(zip(files, groups, strict=True), start=1):
        scenario = scenarios.scenario(group.key)
        encode(file, frames(scenario, rollouts_of(evaluations, group, scenario), theme), float(scenario.dt_s))
        if progress is not None:
            progress(done, len(files))
    return files


def _select_episodes(runs: Sequence[EpisodeTable], which: str) -> list[EpisodeGroup]:
    """Return the requested episodes, worst first."""
    groups = rank_scenarios(runs)
    if which == "all":
        return groups
    if which.startswith("worst:"):
        count = which.removeprefix("worst:")
        if not count.isdecimal() or int(count) < 1:
            cure = "write worst:N with N at least 1, as worst:20"
            raise UsageError(f"{which!r} is not a selection", cure=cure)
        return groups[: int(count)]
    if matches := [group for group in groups if group.scenario_id == which]:
        return matches
    ids = [group.scenario_id for group in groups]
    cure = did_you_mean(which, ids, otherwise="write worst:N, all, or an id of its episodes.csv")
    raise UsageError(f"no episode of scenario {which!r} is stored", file=runs[-1].folder, cure=cure)


def _files(out: Path, groups: Sequence[EpisodeGroup], ranked: bool) -> list[Path]:
    """Return the paths of the files, named by scenario id, with the rank in front if ``ranked``."""
    names = [re.sub(r"[^\w.+-]", "_", group.scenario_id) for group in groups]
    if ranked:
        digits = len(str(len(names)))
        names = [f"{rank:0{digits}d}-{name}" for rank, name in enumerate(names, start=1)]
    return [inside(out, f"{name}.mp4") for name in names]


def frames(scenario: Scenario, rollouts: Sequence[Rollout], theme: str = "light") -> Iterator[Picture]:
    """Yield pictures of all rollouts at every step from the first start on, with the legend below."""
    side = ALONE if len(rollouts) == 1 else SIDE_BY_SIDE
    canvas = Canvas(side, side, theme)
    log_scenery = Scenery(canvas, scenario, rollouts)
    sceneries = [
        log_scenery
        if rollout.others is None
        else Scenery(canvas, replace_traffic(scenario, rollout), rollouts)
        for rollout in rollouts
    ]
    rows = math.ceil(len(rollouts) / _MAX_COLUMNS)
    columns = math.ceil(len(rollouts) / rows)
    legend, dt_s = legend_strip(columns * side, theme), float(scenario.dt_s)
    canvas.clear()
    empty = canvas.pixels()
    for step in range(min(rollout.start for rollout in rollouts), int(scenario.steps)):
        pairs = zip(sceneries, rollouts, strict=True)
        panes = [draw_frame(scenery, rollout, step, dt_s) for scenery, rollout in pairs]
        if columns > 1:
            for pane in panes:
                pane[:, -1, :3] = rgb(canvas.colours["lane"])
        yield np.concatenate((_tile(panes, columns, empty), legend))


def _tile(panes: Sequence[Picture], columns: int, empty: Picture) -> Picture:
    """Arrange pictures of one size in rows, and pad the last row with the picture ``empty``."""
    padded = [*panes, *[empty] * (-len(panes) % columns)]
    rows = [np.concatenate(padded[i : i + columns], axis=1) for i in range(0, len(padded), columns)]
    return np.concatenate(rows)


def encode(file: Path, pictures: Iterator[Picture], dt_s: float) -> None:
    """Write pictures (at least one, all of one even size) as an H.264 video with a picture every ``dt_s`` seconds.

    Raises:
        UsageError: PyAV is not installed.
    """
    with explain_missing_package():
        import av
    options = {"movflags": "+faststart"}
    with atomic_write(file) as target, av.open(target.name, "w", format="mp4", options=options) as container:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                rate, options = Fraction(1 / dt_s).limit_denominator(20), {"preset": "veryfast", "crf": "23"}
                stream = container.add_stream("libx264", rate=rate, options=options)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
        container.mux(stream.encode(None))


Array = np.ndarray[Any, Any]
#: Red, green, blue and an unused alpha: four bytes are copied faster than three.
Picture = UInt8[Array, "_ _ 4"]
#: Metres across the shorter edge of a picture without its bar.
VIEW_M = 70.0
#: Heights of the bar at the top of a picture, and of a line of the legend, pixels.
_BAR, _LINE = 30, 22


class Canvas:
    """Pixels to draw on: shapes in metres under a camera, texts and bars in pixels from the upper left corner.

    Raises:
        UsageError: The theme is unknown, or matplotlib is not installed.
    """

    def __init__(self, width: int, height: int, theme: str) -> None:
        with explain_missing_package():
            from matplotlib.backends.backend_agg import RendererAgg
            from matplotlib.font_manager import FontProperties
            from matplotlib.path import Path
            from matplotlib.transforms import Affine2D
        # At 72 dots per inch a point of matplotlib is a pixel.
        self._agg = RendererAgg(width, height, 72)
        self._path, self._affine, self._font = Path, Affine2D, FontProperties
        self.width, self.height, self.colours = width, height, theme_colours(theme)
        self._camera: Affine2D = Affine2D()

    def clear(self) -> None:
        """Paint everything in the colour of the ground."""
        pixel = np.array([*rgb(self.colours["ground"]), 255], np.uint8)
        np.asarray(self._agg.buffer_rgba()).view(np.uint32).fill(pixel.view(np.uint32)[0])

    def look_at(self, x: float, y: float, scale: float) -> None:
        """Centre the camera on a point (metres), at ``scale`` pixels per metre."""
        camera = self._affine().translate(-x, -y).scale(scale)
        self._camera = camera.translate(self.width / 2, self.height / 2)

    def path(self, lines: Sequence[Array]) -> Any:
        """Combine lines into one path, which is faster to draw; None without lines."""
        paths = [self._path(line) for line in lines if len(line)]
        if len(paths) > 1:
            return self._path.make_compound_path(*paths)
        return paths[0] if paths else None

    def shape(self, shape: Shape) -> None:
        """Draw a shape."""
        self.draw(self.path(shape.lines), shape.line, shape.width, shape.fill, shape.dash)

    def draw(
        self, path: Any, line: str | None, width: float = 1.0, fill: str | None = None, dash: Sequence[float] = ()
    ) -> None:  # fmt: skip
        """Draw a path in metres, if there is one, with an outline of ``width`` pixels."""
        if path is None:
            return
        pen = self._agg.new_gc()
        pen.set_linewidth(width if line else 0.0)
        pen.set_foreground(self.colours[line or fill or "ink"])
        pen.set_capstyle("round")
        pen.set_joinstyle("round")
        if dash:
            pen.set_dashes(0, dash)
        red, green, blue = (value / 255 for value in rgb(self.colours[fill or "ink"]))
        self._agg.draw_path(pen, path, self._camera, (red, green, blue) if fill else None)

    def text(
        self, x: float, y: float, words: str, size: float = 13.0, colour: str = "ink", right: bool = False
    ) -> float:
        """Write a line of text and return its width, pixels; (x, y) is the left or right end of its baseline."""
        font, pen = self._font(size=size), self._agg.new_gc()
        pen.set_foreground(self.colours[colour])
        width = float(self._agg.get_text_width_height_descent(words, font, ismath=False)[0])
        self._agg.draw_text(pen, x - width if right else x, y, words, font, 0)
        return width

    def ring(self, x: float, y: float, radius: float, line: str | None, fill: str | None = None) -> None:
        """Draw a circle in pixels, 2 pixels wide or filled."""
        self._draw_pixels(ring(np.array((x, y)), radius), line, 2.0, fill)

    def bar(self, x: float, y: float, width: float, height: float, fill: str) -> None:
        """Fill a rectangle in pixels with its upper left corner at (x, y)."""
        corners = np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])
        self._draw_pixels(corners, None, 0.0, fill)

    def _draw_pixels(self, points: Array, line: str | None, width: float, fill: str | None) -> None:
        """Draw a polygon in pixels from the upper left corner."""
        camera, self._camera = self._camera, self._affine().scale(1, -1).translate(0, self.height)
        self.draw(self._path(points), line, width, fill)
        self._camera = camera

    def pixels(self) -> Picture:
        """Return a copy of the pixels."""
        return np.asarray(self._agg.buffer_rgba()).copy()


class Scenery:
    """A scenario on a canvas, with a map prepared once and cropped to the surroundings of the rollouts."""

    def __init__(self, canvas: Canvas, scenario: Scenario, rollouts: Sequence[Rollout]) -> None:
        self.canvas, self.scenario = canvas, scenario
        self.drawing = Drawing.of(scenario, surroundings(scenario, rollouts))
        self._ground = [(canvas.path(shape.lines), shape) for shape in self.drawing.ground()]

    def draw(self, rollout: Rollout, step: int) -> None:
        """Draw everything at a step."""
        for path, shape in self._ground:
            self.canvas.draw(path, shape.line, shape.width, shape.fill, shape.dash)
        for shape in (*self.drawing.traffic(step), *self.drawing.ego(rollout.ego, step)):
            self.canvas.shape(shape)


def draw_frame(scenery: Scenery, rollout: Rollout, step: int, dt_s: float) -> Picture:
    """Return one planner's rollout at a step, with its name, outcome, speed, time and past events."""
    canvas = scenery.canvas
    canvas.clear()
    scale = (min(canvas.width, canvas.height) - _BAR) / VIEW_M
    x, y = _last_position(scenery.scenario, rollout, step)
    canvas.look_at(x, y + _BAR / 2 / scale, scale)
    scenery.draw(rollout, step)
    _mark_events(canvas, rollout, step, scale)
    canvas.bar(0, 0, canvas.width, _BAR, "crosswalk")
    width = canvas.text(10, 20, rollout.planner, 14)
    canvas.text(20 + width, 20, rollout.outcome, 12, "mark" if rollout.outcome != "success" else "ink")
    is_absent = not np.isfinite(rollout.ego[step]).all()
    speed = "gone" if is_absent else f"{rollout.ego[step, 3]:.1f} m/s"
    canvas.text(canvas.width - 10, 20, f"{speed}   {step * dt_s:.1f} s", 12, right=True)
    events = ((name, first) for name, first in rollout.events.items() if name in EVENT_WORDS)
    past_events = ((name, first) for name, first in events if 0 <= first <= step)
    for line, (name, first) in enumerate(past_events):
        text = f"✕ {EVENT_WORDS[name]} at {first * dt_s:.1f} s"
        canvas.text(10, _BAR + 18 + 16 * line, text, 12, "mark")
    _scale_bar(canvas, scale)
    return canvas.pixels()


def legend_strip(width: int, theme: str) -> Picture:
    """Return the legend, as wide as a picture and an even number of pixels high."""
    entries, x, y = [], 10.0, 0
    for name, words in LEGEND:
        length = 34 + 7.0 * len(words)  # symbol, gap, and about 7 pixels per letter
        if x + length > width - 10:
            x, y = 10.0, y + _LINE
        entries.append((x, y, name, words))
        x += length
    canvas = Canvas(width, (y + _LINE + 10) // 2 * 2, theme)
    canvas.clear()
    for x, y, name, words in entries:
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
        elif name in LIGHTS:
            canvas.bar(x + 5, middle - 7, 5, 14, name)
        else:
            canvas.bar(x, middle - 5, 16, 10, "outline")
            canvas.bar(x + 1, middle - 4, 14, 8, name)
        canvas.text(x + 21, middle + 4, words, 11)
    return canvas.pixels()


def _last_position(scenario: Scenario, rollout: Rollout, step: int) -> tuple[float, float]:
    """Return the last known position of ego up to a step, else the logged one."""
    steps = np.flatnonzero(np.isfinite(rollout.ego[: step + 1]).all(axis=1))
    point = rollout.ego[steps[-1], :2] if steps.size else scenario.agent_xy[step, 0]
    return float(point[0]), float(point[1])


def _mark_events(canvas: Canvas, rollout: Rollout, step: int, scale: float) -> None:
    """Draw a cross at ego's position of each past event."""
    for event_step in rollout.events.values():
        if 0 <= event_step <= step and np.isfinite(rollout.ego[event_step]).all():
            centre = rollout.ego[event_step, :2]
            for slope in (-1, 1):
                arm = np.array((9.0, slope * 9.0)) / scale
                path = canvas.path([np.array((centre - arm, centre + arm))])
                for colour, width in (("ground", 7.0), ("mark", 3.5)):
                    canvas.draw(path, colour, width)


def _scale_bar(canvas: Canvas, scale: float) -> None:
    length = next(metres for metres in (5, 10, 20, 50, 100) if metres * scale >= 45 or metres == 100)
    base = canvas.height - 12
    canvas.bar(6, base - 22, length * scale + 12, 28, "ground")
    canvas.bar(12, base, length * scale, 2, "ink")
    for x in (12.0, 10 + length * scale):
        canvas.bar(x, base - 6, 2, 8, "ink")
    canvas.text(18, base - 5, f"{length} m", 12)

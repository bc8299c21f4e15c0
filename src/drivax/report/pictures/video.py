"""Rollouts as mp4 files: one planner each, or all of them side by side."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import UsageError, did_you_mean, missing_package
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import atomic_write, check_output
from drivax.report.episodes import EpisodeGroup, EvaluatedSet, ranked, rollouts_of
from drivax.report.pictures.drawing import Rollout, with_traffic_of
from drivax.report.pictures.frames import Canvas, Picture, Scenery, draw_frame, legend_strip
from drivax.report.pictures.palette import THEMES, rgb
from drivax.report.runs import read_evaluations
from drivax.scenario.schema import Scenario

#: Side of a picture in pixels: of one planner alone, of several side by side.
ALONE, SIDE_BY_SIDE = 720, 480
#: Pictures in a row at most.
_ACROSS = 3


def write_videos(
    runs: Sequence[Path],
    out: Path,
    which: str,
    side_by_side: bool = False,
    data: Path | None = None,
    theme: str = "light",
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write episodes of evaluation runs as mp4 files, in real time; returns the files, worst episode first.

    Args:
        runs: Run folders; the last evaluation is the policy, whose episodes are ranked and, alone, drawn.
        out: Folder for the files; each appears when it is complete.
        which: ``worst:N``, ``all``, or the id of a scenario.
        side_by_side: Draw every run with an episode of the scenario in one picture.
        data: The scenario set of the evaluation, where it has moved.
        theme: ``light`` or ``dark``.
        overwrite: Replace existing files.
        progress: Called with (done, total) after every file.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not that of the evaluation.
        UsageError: A file exists, there is no such scenario, or a package for videos is not installed.
    """
    evaluations = read_evaluations(runs)
    groups = _selected(evaluations, which)
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


def _selected(runs: Sequence[EpisodeTable], which: str) -> list[EpisodeGroup]:
    """Return the requested episodes, worst first."""
    groups = ranked(runs)
    if which == "all":
        return groups
    if which.startswith("worst:"):
        count = which.removeprefix("worst:")
        if not count.isdecimal() or int(count) < 1:
            raise UsageError(
                f"{which!r} is not a selection", cure="write worst:N with N at least 1, as worst:20"
            )
        return groups[: int(count)]
    if requested := [group for group in groups if group.scenario_id == which]:
        return requested
    near = did_you_mean(which, [group.scenario_id for group in groups])
    cure = near if near.startswith("did") else "write worst:N, all, or an id of its episodes.csv"
    raise UsageError(f"no episode of scenario {which!r} is stored", file=runs[-1].folder, cure=cure)


def _files(out: Path, groups: Sequence[EpisodeGroup], ranked: bool) -> list[Path]:
    """Return the names of the files: the scenario's id, after its rank in a ranking."""
    names = [re.sub(r"[^\w.+-]", "_", group.scenario_id) for group in groups]
    digits = len(str(len(names)))
    return [
        out / (f"{place:0{digits}d}-{name}.mp4" if ranked else f"{name}.mp4")
        for place, name in enumerate(names, start=1)
    ]


def frames(scenario: Scenario, rollouts: Sequence[Rollout], theme: str = "light") -> Iterator[Picture]:
    """Yield pictures of all rollouts at every step from the first takeover on, with the legend below."""
    side = ALONE if len(rollouts) == 1 else SIDE_BY_SIDE
    canvas = Canvas(side, side, theme)
    recorded = Scenery(canvas, scenario, rollouts)
    sceneries = [
        recorded if rollout.others is None else Scenery(canvas, with_traffic_of(rollout, scenario), rollouts)
        for rollout in rollouts
    ]
    across = (
        len(rollouts) if len(rollouts) <= _ACROSS else -(-len(rollouts) // (-(-len(rollouts) // _ACROSS)))
    )
    legend = legend_strip(across * side, theme)
    for step in range(min(rollout.start for rollout in rollouts), int(scenario.steps)):
        panes = [
            draw_frame(scenery, rollout, step, float(scenario.dt_s))
            for scenery, rollout in zip(sceneries, rollouts, strict=True)
        ]
        for pane in panes if across > 1 else ():
            pane[:, -1, :3] = rgb(THEMES[theme]["lane"])
        yield np.concatenate((_tiled(panes, across), legend))


def _tiled(panes: Sequence[Picture], across: int) -> Picture:
    """Return pictures of one size in rows, the last row filled with empty ones."""
    missing = -len(panes) % across
    filled = [*panes, *(np.full_like(panes[0], panes[0][-1, -1]) for _ in range(missing))]
    rows = [np.concatenate(filled[at : at + across], axis=1) for at in range(0, len(filled), across)]
    return np.concatenate(rows)


def encode(file: Path, pictures: Iterator[Picture], dt_s: float) -> None:
    """Write pictures as H.264, which every browser plays; the file appears when it is complete.

    Args:
        file: The mp4 file.
        pictures: At least one, all of one even width and height.
        dt_s: Seconds between pictures.

    Raises:
        UsageError: PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise missing_package(error) or error from error
    faststart = {"movflags": "+faststart"}
    with (
        atomic_write(file) as target,
        av.open(target.name, "w", format="mp4", options=faststart) as container,
    ):
        stream: Any = None
        for picture in pictures:
            if stream is None:
                rate = Fraction(1 / dt_s).limit_denominator(20)
                options = {"preset": "veryfast", "crf": "23"}
                stream = container.add_stream("libx264", rate=rate, options=options)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
        container.mux(stream.encode(None))

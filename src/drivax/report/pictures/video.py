"""Drives as mp4 files: one planner each, or all of them side by side."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.report.episode_selection import Choice, ranked
from drivax.report.episodes import DrivenSet, drives_of
from drivax.report.loaded_runs import Evaluation, read_runs
from drivax.report.pictures.episode import Drive, as_driven
from drivax.report.pictures.frames import Canvas, Picture, Scenery, draw_frame, legend_strip
from drivax.report.pictures.palette import THEMES
from drivax.scenario.schema import Scenario

#: Side of a picture in pixels: of one planner alone, of several side by side.
ALONE, BESIDE = 720, 480
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
    """Write drives of evaluation runs as mp4 files, in real time at the scenario's own rate.

    Args:
        runs: Run folders; the last evaluation is the policy, whose drives are ranked and, alone, drawn.
        out: Folder for the files; each appears when it is complete.
        which: ``worst:N``, ``all``, or the id of a scenario.
        side_by_side: Draw every run that drove the scenario, in one picture.
        data: The scenario set that was driven, where it has moved.
        theme: ``light`` or ``dark``.
        overwrite: Replace existing files.
        progress: Called with (done, total) after every file.

    Returns:
        The files, in the order of the ranking.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not the one that was driven.
        UsageError: A file exists, there is no such scenario, or what writes videos is not installed.
    """
    evaluations, _ = read_runs(runs)
    if not evaluations:
        raise UsageError("no evaluation was given", cure="name run folders of drivax evaluate")
    chosen = _chosen(evaluations, which)
    if not side_by_side:
        evaluations, chosen = evaluations[-1:], [_alone(choice) for choice in chosen]
    files = _files(out, chosen, ranked=len(chosen) > 1 or which == "all" or which.startswith("worst:"))
    for file in files:
        if file.exists() and not overwrite:
            raise UsageError("exists already", file=file, cure="choose another folder or pass --overwrite")
    driven = DrivenSet(evaluations[-1], data)
    out.mkdir(parents=True, exist_ok=True)
    for done, (file, choice) in enumerate(zip(files, chosen, strict=True), start=1):
        scenario = driven.scenario((choice.dataset, choice.scenario_id))
        drives = drives_of(evaluations, choice, scenario)
        encode(file, frames(scenario, drives, theme), dt_s=float(scenario.dt_s))
        if progress is not None:
            progress(done, len(files))
    return files


def _chosen(runs: Sequence[Evaluation], which: str) -> list[Choice]:
    """What is asked for, worst first."""
    choices = ranked(runs)
    if which == "all":
        return choices
    if which.startswith("worst:"):
        count = which.removeprefix("worst:")
        if not count.isdecimal() or int(count) < 1:
            raise UsageError(
                f"{which!r} is no selection", cure="write worst:N with N at least 1, as worst:20"
            )
        return choices[: int(count)]
    found = [choice for choice in choices if choice.scenario_id == which]
    if not found:
        near = difflib.get_close_matches(which, [choice.scenario_id for choice in choices], n=1)
        cure = f"did you mean {near[0]!r}?" if near else "write worst:N, all, or an id of its episodes.csv"
        raise UsageError(f"no drive of scenario {which!r} is stored", file=runs[-1].folder, cure=cure)
    return found


def _alone(choice: Choice) -> Choice:
    return Choice(choice.dataset, choice.scenario_id, choice.rows[-1:], choice.outcome)


def _files(out: Path, chosen: Sequence[Choice], ranked: bool) -> list[Path]:
    """Names of the files: the scenario's id, with its rank before it where there is a ranking."""
    names = [re.sub(r"[^\w.+-]", "_", choice.scenario_id) for choice in chosen]
    digits = len(str(len(names)))
    return [
        out / (f"{place:0{digits}d}-{name}.mp4" if ranked else f"{name}.mp4")
        for place, name in enumerate(names, start=1)
    ]


def frames(scenario: Scenario, drives: Sequence[Drive], theme: str = "light") -> Iterator[Picture]:
    """Pictures of all drives at every step from where the first planner takes over, with the legend below.

    Args:
        scenario: The scenario.
        drives: What each planner did.
        theme: ``light`` or ``dark``.
    """
    side = ALONE if len(drives) == 1 else BESIDE
    canvas = Canvas(side, side, theme)
    recorded = Scenery(canvas, scenario, drives)
    sceneries = [
        recorded if drive.others is None else Scenery(canvas, as_driven(scenario, drive), drives)
        for drive in drives
    ]
    across = len(drives) if len(drives) <= _ACROSS else -(-len(drives) // (-(-len(drives) // _ACROSS)))
    legend = legend_strip(across * side, theme)
    for step in range(min(drive.start for drive in drives), int(scenario.steps)):
        panes = [
            draw_frame(scenery, drive, step, float(scenario.dt_s))
            for scenery, drive in zip(sceneries, drives, strict=True)
        ]
        for pane in panes if across > 1 else ():
            pane[:, -1, :3] = np.array([int(THEMES[theme]["lane"][at : at + 2], 16) for at in (1, 3, 5)])
        yield np.concatenate((_tiled(panes, across), legend))


def _tiled(panes: Sequence[Picture], across: int) -> Picture:
    """Pictures of one size in rows, the last one filled up with empty ones."""
    missing = -len(panes) % across
    filled = [*panes, *(np.full_like(panes[0], panes[0][-1, -1]) for _ in range(missing))]
    rows = [np.concatenate(filled[at : at + across], axis=1) for at in range(0, len(filled), across)]
    return np.concatenate(rows)


def encode(file: Path, pictures: Iterator[Picture], dt_s: float) -> None:
    """Write pictures as H.264, which every browser plays; the file appears when it is complete.

    Args:
        file: The mp4 file.
        pictures: At least one, all of one even width and height.
        dt_s: Seconds from one to the next.

    Raises:
        UsageError: PyAV is not installed.
    """
    try:
        import av
    except ModuleNotFoundError as error:
        raise UsageError("PyAV is not installed", cure="pip install 'drivax[show]'") from error
    partial = file.with_name(f".{file.name}.partial-{os.getpid()}")
    try:
        with av.open(partial, "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream: Any = None
            for picture in pictures:
                if stream is None:
                    rate = Fraction(1 / dt_s).limit_denominator(20)
                    stream = container.add_stream(
                        "libx264", rate=rate, options={"preset": "veryfast", "crf": "23"}
                    )
                    stream.height, stream.width = picture.shape[:2]
                    stream.pix_fmt = "yuv420p"
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
            container.mux(stream.encode(None))
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)

"""``drivax report``: an HTML page, videos or tables from run folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from drivax.escaping import show


@dataclass(frozen=True)
class Report:
    """Write one self-contained HTML page, videos or tables from evaluation and training runs.

    The page has tables with intervals, paired differences, kinds of collision, distributions, all episodes, episodes
    side by side and learning curves; it needs no network. The last evaluation is compared with the others. --video,
    --side-by-side and --tables write files into the folder --out instead.

    Example: drivax report runs/constant runs/idm runs/policy runs/training --out report.html

    Example: drivax report runs/policy --video worst:20 --out videos

    Example: drivax report runs/idm runs/policy --side-by-side w2-grid-s0-000011-t_junction --out videos

    Example: drivax report runs/idm runs/policy --tables --out tables
    """

    runs: Positional[tuple[Path, ...]]
    """Run folders written by drivax evaluate and drivax train."""
    out: Path | None = None
    """HTML file, or folder of videos or tables; report.html, videos or tables in the last run folder by default."""
    data: Path | None = None
    """Scenario set of the runs, if it has moved since."""
    episodes: int = 12
    """Number of playable episodes; a page with 0 has no rollouts and no tags."""
    video: str | None = None
    """Write mp4 files of the last evaluation's episodes: worst:N, all, or the id of a scenario."""
    side_by_side: str | None = None
    """Write mp4 files with all comparable evaluations in one picture: worst:N, all, or the id of a scenario."""
    theme: Literal["light", "dark"] = "light"
    """Colours of videos; the page follows the browser's setting."""
    tables: bool = False
    """Write the tables as CSV (all digits), Markdown and LaTeX."""
    metrics: tuple[str, ...] = ()
    """Further metrics of --tables, by name or as a set (training, full)."""
    overwrite: bool = False
    """Replace existing files."""


def run(args: Report) -> int:
    """Write the page, the videos or the tables, and print their path."""
    from drivax.errors import UsageError
    from drivax.files import inside
    from drivax.report.pages.report import write_report, write_tables
    from drivax.report.pictures.video import write_videos
    from drivax.tracking.progress import Progress

    if not args.runs:
        raise UsageError("no run is named", cure="drivax report RUN [RUN ...]")
    if sum((args.video is not None, args.side_by_side is not None, args.tables)) > 1:
        problem = "--video, --side-by-side and --tables are mutually exclusive"
        raise UsageError(problem, cure="run drivax report once for each")
    if args.metrics and not args.tables:
        raise UsageError("--metrics chooses columns of --tables", cure="pass --tables, or leave it out")
    episodes = args.video if args.video is not None else args.side_by_side
    if episodes is not None:
        out = args.out or inside(args.runs[-1], "videos")
        with Progress("drawing", "videos") as bar:
            files = write_videos(
                args.runs, out, episodes, args.side_by_side is not None, args.data, args.theme, args.overwrite,
                progress=lambda done, total: bar.update(done, total=total),
            )  # fmt: skip
        show(f"{out} ({len(files)} videos)")
        return 0
    if args.tables:
        out = args.out or inside(args.runs[-1], "tables")
        files = write_tables(args.runs, out, args.data, args.overwrite, args.metrics)
        show(f"{out} ({', '.join(file.name for file in files)})")
        return 0
    out = args.out or inside(args.runs[-1], "report.html")
    path = write_report(args.runs, out, args.data, args.episodes, args.overwrite)
    show(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0

"""``drivax report``: one HTML page from run folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Report:
    """Write one self-contained HTML page from evaluation and training runs.

    The page holds tables with intervals, paired differences, drives side by side and learning curves; it needs no
    network. The last evaluation named is the policy that the others are compared with.

    Example: drivax report runs/constant runs/idm runs/policy runs/training --out report.html
    """

    runs: Positional[tuple[Path, ...]]
    """Run folders written by drivax evaluate and drivax train."""
    out: Path | None = None
    """HTML file to write; report.html in the last run folder where it is left out."""
    data: Path | None = None
    """Scenario set that was driven, where it has moved since."""
    episodes: int = 12
    """How many episodes to show; 0 leaves them out."""
    overwrite: bool = False
    """Replace an existing file."""


def run(args: Report) -> int:
    """Write the report and say where it is."""
    from drivax.errors import UsageError
    from drivax.show.report import write_report

    if not args.runs:
        raise UsageError("no run was given", cure="drivax report RUN [RUN ...]")
    out = args.out or args.runs[-1] / "report.html"
    path = write_report(args.runs, out, args.data, args.episodes, args.overwrite)
    print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0

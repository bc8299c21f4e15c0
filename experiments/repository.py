"""Paths of docs and stored results, and files that are only in the history of the repository."""

from __future__ import annotations

import io
import subprocess
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
#: JSON summaries, at most 300 kB each.
RESULTS = ROOT / "experiments" / "results"
#: Resumable state of long experiments; remove it when they end.
STATE = ROOT / "experiments" / "state"
#: A commit whose tree holds the episodes, score tables and weights of the experiments before 26 November 2026.
STORED = "03b904f"


def fetch(path: str, out: Path) -> Path:
    """Extract ``path`` of commit ``STORED`` into ``out`` unless it exists, and return ``out``."""
    if not out.exists():
        archive = subprocess.run(
            ["git", "archive", f"{STORED}:{path}"], cwd=ROOT, check=True, capture_output=True
        ).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as archive_file:
            archive_file.extractall(out, filter="data")
    return out


def fill_places(text: str, script: str, tables: Mapping[str, Sequence[str]]) -> str:
    """Return a page with the lines of each table between the comments ``script: NAME`` and ``script: end``, if any."""
    end = f"<!-- {script}: end -->"
    for name, lines in tables.items():
        begin = f"<!-- {script}: {name} -->"
        before, found, rest = text.partition(begin)
        if found:
            content = "\n".join(lines)
            text = f"{before}{begin}\n\n{content}\n\n{end}{rest.split(end, 1)[1]}"
    return text


def save_picture(figure: Figure, out: Path) -> None:
    """Write a figure as a PNG of 256 colours, a third of the size of true colour."""
    png = io.BytesIO()
    figure.savefig(png, format="png")
    Image.open(png).convert("RGB").quantize(dither=Image.Dither.NONE).save(out, optimize=True)

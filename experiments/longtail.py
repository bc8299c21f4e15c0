"""The long-tail study on the built-in world's benchmark, kept so that it can go on elsewhere.

drivax study longtail --data BENCHMARK --out STUDY
python -m experiments.longtail keep --out STUDY      (what is done, into experiments/state/longtail)
python -m experiments.longtail restore --out STUDY   (what was kept, into a new folder, where the study continues)
python -m experiments.longtail finish --out STUDY    (its results, into experiments/results/longtail.json)
python -m experiments.longtail table                 (the results that were kept, into the page)

Of every arm the run without its checkpoints and the episodes are kept, and so are the scores, without what they are
made of: another processor rounds otherwise, and what was trained with other weights belongs to another study.
BENCHMARK is what `drivax generate BENCHMARK --benchmark` tested.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np

from drivax.curation.arms import ClaimGroup
from drivax.evaluation.episode_table import EpisodeTable
from drivax.studies import longtail_page
from drivax.studies.longtail_drives import (
    DRIVES,
    REFERENCES,
    RUNS,
    SCORES,
    evaluation_of,
    is_evaluated,
    names,
    run_of,
)
from experiments.learning.tables import table
from experiments.repository import DOCS, RESULTS, STATE, fetched

KEPT, RESULT = STATE / "longtail", RESULTS / "longtail.json"
PAGE = DOCS / "results" / "longtail.md"
BEGIN, END = "<!-- longtail.py: {} -->", "<!-- longtail.py: end -->"
#: What of a folder is kept.
FILES = ("config.yaml", "run.json", "metrics.jsonl", "episodes.csv")


def keep(study: Path) -> None:
    """Keeps every arm that has episodes and is not kept yet, the study's own files, its scores and its results."""
    KEPT.mkdir(parents=True, exist_ok=True)
    _pack([study], study, KEPT / "study.tar.xz")
    for name in REFERENCES:
        if (study / DRIVES / name).is_dir():
            _pack([study / DRIVES / name], study, KEPT / f"{name}.tar.xz")
    for arm, seed in _agents(study):
        file = KEPT / f"{arm}-{seed}.tar.xz"
        if not file.exists() and is_evaluated(study, arm, seed):
            folders = [run_of(study, arm, seed), *(evaluation_of(study, name, seed) for name in names(arm))]
            _pack(folders, study, file)
    (KEPT / SCORES).mkdir(exist_ok=True)
    for file in (study / SCORES).glob("*.npz"):
        with np.load(file) as table:
            arrays = {name: table[name] for name in table if not name.startswith("component_")}
        np.savez_compressed(KEPT / SCORES / file.name, allow_pickle=False, **arrays)


def restore(study: Path) -> None:
    """Put what was kept, or else the study of the repository's history, where the study looks for it."""
    kept = fetched("benchmarks/results/longtail", KEPT)
    study.mkdir(parents=True)
    for file in sorted(kept.glob("*.tar.xz")):
        with tarfile.open(file) as packed:
            packed.extractall(study, filter="data")
    shutil.copytree(kept / SCORES, study / SCORES)


def finish(study: Path) -> None:
    """Store the results, and the number of test episodes with a collision by planner or arm and seed."""
    results = json.loads((study / "results.json").read_text())
    collisions = {
        name: [
            int(EpisodeTable.read(folder).metrics["collision"].sum()) for folder in _evaluations(study, name)
        ]
        for name in results["rates"]
    }
    RESULT.write_text(json.dumps(results | {"collisions": collisions}, indent=1) + "\n")


def _evaluations(study: Path, name: str) -> list[Path]:
    folder = study / DRIVES / name
    return [folder] if name in REFERENCES else sorted(folder.glob("seed-*"))


def filled(page: str, results: dict[str, Any]) -> str:
    """The page with its tables as the study found them."""
    parts = {
        "conditions": longtail_page.conditions(results),
        "draws": longtail_page.draws(results),
        "rankings": longtail_page.rankings(results),
        "mean q": longtail_page.mean_q(results),
        "mean q curve": longtail_page.mean_q_curve(results),
        **{f"claims {group}": longtail_page.verdicts(results, group) for group in get_args(ClaimGroup)},
        **{f"rates {kind}": longtail_page.rates(results, kind) for kind in ("ordinary", "common", "rare")},
        "detectable": (
            ("metric", "smallest difference"),
            [(f"`{name}`", f"{least:.3f}") for name, least in results["detectable"].items()],
        ),
    }
    for name, cells in parts.items():
        before, rest = page.split(BEGIN.format(name))
        page = "\n".join([before + BEGIN.format(name), "", *table(*cells), "", END + rest.split(END, 1)[1]])
    return page


def _agents(study: Path) -> Iterator[tuple[str, int]]:
    for run in sorted((study / RUNS).glob("*/seed-*")):
        yield run.parent.name, int(run.name.removeprefix("seed-"))


def _pack(folders: list[Path], study: Path, out: Path) -> None:
    """The files of some folders, without paths of the machine."""
    with tarfile.open(out, "w:xz") as packed:
        for file in (folder / name for folder in folders for name in FILES):
            if file.is_file():
                content = _without_paths(file)
                about = tarfile.TarInfo(str(file.relative_to(study)))
                about.size = len(content)
                packed.addfile(about, io.BytesIO(content))


def _without_paths(file: Path) -> bytes:
    """What a file says, with data and runs by name: where they lie is the machine's own affair."""
    if file.name == "run.json":
        planner_name = json.loads(file.read_bytes())
        planner_name.pop("command", None)  # a restored study tells none
        for entry in (*planner_name["data"], *planner_name.get("trained_on", ())):
            entry["path"] = Path(entry["path"]).name
        return json.dumps(planner_name).encode()
    if file.name == "config.yaml":
        return re.sub(rf"(?m)^(planner: ).*/({RUNS}/)", r"\1\2", file.read_text()).encode()
    return file.read_bytes()


def main() -> None:
    """Keep, restore, store the results, or fill the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("keep", "restore", "finish", "table"))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.what == "table":
        PAGE.write_text(filled(PAGE.read_text(), json.loads(RESULT.read_text())))
    elif args.out is None:
        parser.error("the following arguments are required: --out")
    else:
        {"keep": keep, "restore": restore, "finish": finish}[args.what](args.out)


if __name__ == "__main__":
    main()

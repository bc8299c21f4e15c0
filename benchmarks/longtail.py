"""The long-tail study on the built-in world's benchmark, kept so that it can go on elsewhere.

drivax study longtail --data BENCHMARK --out STUDY
python benchmarks/longtail.py keep --out STUDY      (what is done, into benchmarks/results/longtail)
python benchmarks/longtail.py restore --out STUDY   (what was kept, into a new folder, where the study goes on)

Of every agent the run without its checkpoints and the episodes are kept, and so are the scores of the scouts.
BENCHMARK is what `drivax generate BENCHMARK --benchmark` made.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drivax.studies.longtail_drives import has_driven, names
from drivax.studies.longtail_plan import DRIVES, RESULTS, RUNS, SCORES, drive_of, run_of

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "benchmarks" / "results" / "longtail"
#: Scores whose making takes a training.
ENSEMBLE = "ensemble.npz"
#: What of a folder is kept.
FILES = ("config.yaml", "run.json", "metrics.jsonl", "episodes.csv")


def keep(study: Path) -> None:
    """Keeps every agent that has driven and is not kept yet, the study's own files, its scouts and its results."""
    KEPT.mkdir(parents=True, exist_ok=True)
    _pack([study], study, KEPT / "study.tar.xz")
    _pack([study / DRIVES / "expert"], study, KEPT / "expert.tar.xz")
    for agent, seed in _agents(study):
        file = KEPT / f"{agent}-{seed}.tar.xz"
        if not file.exists() and has_driven(study, agent, seed):
            folders = [run_of(study, agent, seed), *(drive_of(study, name, seed) for name in names(agent))]
            _pack(folders, study, file)
    for file in (study / SCORES / ENSEMBLE, study / RESULTS):
        if file.is_file():
            shutil.copyfile(file, KEPT / file.name)


def restore(study: Path) -> None:
    """Puts what was kept where the study looks for it."""
    study.mkdir(parents=True)
    for file in sorted(KEPT.glob("*.tar.xz")):
        with tarfile.open(file) as packed:
            packed.extractall(study, filter="data")
    (study / SCORES).mkdir()
    if (KEPT / ENSEMBLE).is_file():
        shutil.copyfile(KEPT / ENSEMBLE, study / SCORES / ENSEMBLE)


def _agents(study: Path) -> Iterator[tuple[str, int]]:
    for run in sorted((study / RUNS).glob("*/seed-*")):
        yield run.parent.name, int(run.name.removeprefix("seed-"))


def _pack(folders: list[Path], study: Path, out: Path) -> None:
    """The files of some folders, without paths of the machine."""
    with tarfile.open(out, "w:xz") as packed:
        for file in (folder / name for folder in folders for name in FILES):
            if file.is_file():
                content = file.read_bytes()
                if file.name == "run.json":
                    content = _without_paths(json.loads(content))
                about = tarfile.TarInfo(str(file.relative_to(study)))
                about.size = len(content)
                packed.addfile(about, io.BytesIO(content))


def _without_paths(told: dict[str, Any]) -> bytes:
    """``run.json``, its data by name; the command would tell where the study lies."""
    data = [entry | {"path": Path(entry["path"]).name} for entry in told["data"]]
    return (json.dumps({name: told[name] for name in told if name != "command"} | {"data": data})).encode()


def main() -> None:
    """Keep or restore."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("keep", "restore"))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    {"keep": keep, "restore": restore}[args.what](args.out)


if __name__ == "__main__":
    main()

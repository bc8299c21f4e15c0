"""Store and resume the long-tail studies on the built-in world's benchmark.

drivax study NAME --data BENCHMARK --out STUDY           (longtail, longtail2_screening or longtail2)
python -m experiments.longtail keep NAME --out STUDY      (store finished parts in experiments/state/NAME)
python -m experiments.longtail restore NAME --out STUDY   (restore them to a new folder, where the study continues)
python -m experiments.longtail finish NAME --out STUDY    (write the results to experiments/results/NAME.json)
python -m experiments.longtail table NAME                 (write the stored results to the page)
python -m experiments.longtail power --out STUDY          (what a study with more seeds and events than the screening,
                                                           STUDY, detects; stored in experiments/results)

`keep` stores each arm's run without checkpoints, its episodes, and the scores: another processor rounds differently,
and runs trained with other weights belong to another study.
BENCHMARK is the output of `drivax generate BENCHMARK --benchmark`.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from drivax.curation.methods import event_kinds
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import write_json
from drivax.scenario.store import ScenarioSet
from drivax.seal import seal
from drivax.stats.clusters import recordings_of
from drivax.stats.seeds import crossed_difference
from drivax.studies import report
from drivax.studies.definition import Stratum, Study, StudyConfig, StudySets, load_study
from drivax.studies.study import is_evaluated
from drivax.studies.verdicts import confidence_level
from drivax.tracking.run_folder import versions
from experiments.learning.tables import table
from experiments.repository import DOCS, RESULTS, STATE, fetch, fill_places

#: Pages of the studies.
PAGES = {
    name: DOCS / "results" / f"{name.removesuffix('_screening')}.md"
    for name in ("longtail", "longtail2_screening", "longtail2")
}
POWER = RESULTS / "longtail2_power.json"
#: Metric of the power, seeds of the screening, and numbers of claims that are adjusted together.
PRIMARY, SCREENING_SEEDS, CLAIMS = "at_fault_collision", 2, (1, 6)
#: Stored files of a run or evaluation.
FILES = ("config.yaml", "run.json", "metrics.jsonl", "episodes.csv", "summary.json")


def result_file(name: str) -> Path:
    """Return the file of a study's results."""
    return RESULTS / f"{name}.json"


def keep(name: str, folder: Path) -> None:
    """Store new evaluated arms, the study's own files, and scores."""
    study, kept = stored_study(name, folder), STATE / name
    kept.mkdir(parents=True, exist_ok=True)
    _pack([folder], folder, kept / "study.tar.xz")
    for planner in study.definition.planners:
        if study.evaluation(planner).is_dir():
            _pack([study.evaluation(planner)], folder, kept / f"{planner}.tar.xz")
    for run in sorted((folder / "runs").glob("*/seed-*")):
        arm, seed = run.parent.name, int(run.name.removeprefix("seed-"))
        file = kept / f"{arm}-{seed}.tar.xz"
        if not file.exists() and is_evaluated(study, arm, seed):
            evaluations = (study.evaluation(policy, seed) for policy in study.evaluations(arm))
            _pack([run, *evaluations], folder, file)
    shutil.copytree(folder / "scores", kept / "scores", dirs_exist_ok=True)


def restore(name: str, folder: Path) -> None:
    """Restore the stored study to a new folder; the first study, if it is not stored, from the repository's history."""
    state = fetch("benchmarks/results/longtail", STATE / name) if name == "longtail" else STATE / name
    folder.mkdir(parents=True)
    for file in sorted(state.glob("*.tar.xz")):
        with tarfile.open(file) as archive:
            archive.extractall(folder, filter="data")
    shutil.copytree(state / "scores", folder / "scores")
    # Stored files have no local paths, so they differ from those that were sealed.
    for file in folder.rglob("run.json"):
        seal(file.parent, *FILES, "trajectories.npz", "crashes.json")


def finish(name: str, folder: Path) -> None:
    """Store the results, and the number of test episodes with a collision by planner or arm and seed."""
    study, results = stored_study(name, folder), json.loads((folder / "results.json").read_text())
    collisions = {}
    for planner in results["rates"]:
        seeds = [None] if planner in study.definition.planners else range(results["about"]["seeds"])
        tables = [EpisodeTable.read(study.evaluation(planner, seed)) for seed in seeds]
        collisions[planner] = [int(table.metrics["collision"].sum()) for table in tables]
    result_file(name).write_text(json.dumps(results | {"collisions": collisions}, indent=1) + "\n")


def power(folder: Path) -> None:
    """Store the smallest differences at events that studies of several sizes detect with a power of 80 %.

    Variances are means over the weighted arms of the screening, each against the uniform arm of its algorithm. Progress
    is not matched: its errors come on top.
    """
    study, test = stored_study("longtail2_screening", folder), ScenarioSet.open(folder / "test")
    rare, labels = event_kinds(test) > 0, recordings_of(test.entries)
    uniform = {arm.preset: name for name, arm in study.arms.items() if arm.method == "uniform"}
    values = {
        name: np.stack(
            [
                EpisodeTable.read(study.evaluation(name, seed)).metrics[PRIMARY]
                for seed in range(SCREENING_SEEDS)
            ]
        )
        for name in study.arms
    }
    effects = [
        crossed_difference(values[name], values[uniform[arm.preset]], labels, rare.astype(np.float64))
        for name, arm in study.arms.items()
        if arm.method != "uniform"
    ]
    mean = replace(
        effects[0],
        seeds=tuple(np.mean([effect.seeds for effect in effects], axis=0).tolist()),
        scenarios=float(np.mean([effect.scenarios for effect in effects])),
        interaction=tuple(np.mean([effect.interaction for effect in effects], axis=0).tolist()),
    )
    events = int(rare.sum())
    rows = [
        {
            "seeds": seeds,
            "events": events * more,
            "detectable": [
                mean.with_clusters(mean.clusters * more)
                .with_seeds(seeds)
                .detectable(confidence=confidence_level(claims))
                for claims in CLAIMS
            ],
        }
        for seeds in (2, 5, 8, 16)
        for more in (1, 8)
    ]
    content = {
        "command": "python -m experiments.longtail power --out STUDY", "metric": PRIMARY, "claims": CLAIMS,
        "arms": len(effects), "rows": rows, "versions": versions(),
    }  # fmt: skip
    write_json(POWER, content)


def stored_study(name: str, folder: Path) -> Study:
    """Return the study in a folder, without its scenario sets."""
    return Study(load_study(name), StudyConfig(), StudySets(folder, folder, ()), folder)


def fill_page(page: str, name: str, results: dict[str, Any]) -> str:
    """Return the page, filled with those of a study's tables that it has places for."""
    definition = load_study(name)
    rule = definition.checkpoints_by.rpartition("/")[2]
    tables = {
        "conditions": report.conditions_table(results),
        "critics": report.critics_table(results),
        "detectable": report.detectable_table(results),
        "events": report.events_table(results),
        "draws": report.draws_table(results),
        "rankings": report.rankings_table(results),
        "rule cost": report.rule_cost_table(results, rule),
        "validations": report.validations_table(results, rule),
        **{f"claims {group}": report.claims_table(results, group) for group in definition.groups},
        **{f"rates {stratum}": report.rates_table(results, stratum) for stratum in get_args(Stratum)},
    }
    lines = {
        f"{name} {part}": table(
            [column.heading for column in content.columns],
            [[cell.text for cell in row] for row in content.rows],
        )
        for part, content in tables.items()
    }
    lines["power"] = power_table(json.loads(POWER.read_text()))
    return fill_places(page, "longtail.py", lines)


def power_table(results: dict[str, Any]) -> list[str]:
    """Return the table of smallest detectable differences: a row per study size, a column per number of claims."""
    headings = [
        "seeds",
        "events",
        *(f"of {claims} claims" if claims > 1 else "one claim" for claims in results["claims"]),
    ]
    rows = [
        [str(row["seeds"]), f"{row['events']:,}", *(f"{value:.3f}" for value in row["detectable"])]
        for row in results["rows"]
    ]
    return table(headings, rows)


def _pack(folders: list[Path], study: Path, out: Path) -> None:
    """Pack the files of folders, without local paths."""
    with tarfile.open(out, "w:xz") as archive:
        for file in (folder / name for folder in folders for name in FILES):
            if file.is_file():
                content = _without_paths(file)
                entry = tarfile.TarInfo(str(file.relative_to(study)))
                entry.size = len(content)
                archive.addfile(entry, io.BytesIO(content))


def _without_paths(file: Path) -> bytes:
    """Replace local paths in the content of a file by names of data and runs."""
    if file.name == "run.json":
        info = json.loads(file.read_bytes())
        info.pop("command", None)  # a restored study has none
        for entry in (*info["data"], *info.get("trained_on", ())):
            entry["path"] = Path(entry["path"]).name
        return json.dumps(info).encode()
    if file.name == "config.yaml":
        return re.sub(r"(?m)^(planner: ).*/(runs/)", r"\1\2", file.read_text()).encode()
    return file.read_bytes()


def main() -> None:
    """Store, restore, finish, or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="what", required=True)
    for what in ("keep", "restore", "finish", "table", "power"):
        command = commands.add_parser(what)
        if what != "power":
            command.add_argument("name", choices=tuple(PAGES))
        if what != "table":
            command.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.what == "power":
        power(args.out)
    elif args.what == "table":
        page, results = PAGES[args.name], json.loads(result_file(args.name).read_text())
        page.write_text(fill_page(page.read_text(), args.name, results))
    else:
        {"keep": keep, "restore": restore, "finish": finish}[args.what](args.name, args.out)


if __name__ == "__main__":
    main()

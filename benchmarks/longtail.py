"""The long-tail study on the built-in world's benchmark, kept so that it can go on elsewhere.

drivax study longtail --data BENCHMARK --out STUDY
python benchmarks/longtail.py keep --out STUDY      (what is done, into benchmarks/results/longtail)
python benchmarks/longtail.py restore --out STUDY   (what was kept, into a new folder, where the study goes on)
python benchmarks/longtail.py table                 (the results that were kept, into the page)

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
from typing import Any, get_args

from drivax.studies.longtail_drives import has_driven, names
from drivax.studies.longtail_plan import DRIVES, RESULTS, RUNS, SCORES, drive_of, run_of
from drivax.studies.longtail_results import Group
from learning_tables import interval, table

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "benchmarks" / "results" / "longtail"
PAGE = ROOT / "docs" / "results" / "longtail.md"
BEGIN, END = "<!-- longtail.py: {} -->", "<!-- longtail.py: end -->"
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


def filled(page: str, results: dict[str, Any]) -> str:
    """The page with its tables as the study found them."""
    parts = {
        "conditions": conditions(results),
        "detectable": detectable(results),
        "draws": draws(results),
        "rankings": rankings(results),
        "mean q": mean_q(results),
        **{f"claims {group}": claims(results, group) for group in get_args(Group)},
        **{f"rates {kind}": rates(results, kind) for kind in ("ordinary", "common", "rare")},
    }
    for name, lines in parts.items():
        before, rest = page.split(BEGIN.format(name))
        page = "\n".join([before + BEGIN.format(name), "", *lines, "", END + rest.split(END, 1)[1]])
    return page


def conditions(results: dict[str, Any]) -> list[str]:
    """How well drives what everything is compared with."""
    heads = [
        "agent",
        "share of the expert's progress",
        "worst seed",
        "score, third to last quarter",
        "either way",
        "met",
    ]
    rows = [
        [
            f"`{one['agent']}`", f"{one['progress']:.1%}", f"{one['least']:.1%}", f"{one['change']:+.3f}",
            f"{one['moved']:.3f}", "yes" if one["met"] else "no",
        ]
        for one in results["conditions"]
    ]  # fmt: skip
    return table(heads, rows)


def detectable(results: dict[str, Any]) -> list[str]:
    """The smallest difference that is found, by metric."""
    return table(
        ["metric", "smallest difference"],
        [[f"`{name}`", f"{x:.3f}"] for name, x in results["detectable"].items()],
    )


def claims(results: dict[str, Any], group: str) -> list[str]:
    """Verdicts of a group."""
    rows = []
    for one in results["claims"]:
        if one["claim"]["group"] == group:
            change, found = one["change"], one["interval"]
            rows.append(
                [
                    one["claim"]["words"],
                    "" if found is None else f"{one['difference']:+.3f} [{found[0]:+.3f}, {found[1]:+.3f}]",
                    "" if change is None else "{:+.0%} [{:+.0%}, {:+.0%}]".format(*change),
                    "" if one["adjusted"] is None else f"{one['adjusted']:.3f}".replace("0.000", "<0.001"),
                    f"{one['verdict']}{': ' + one['needed'] if one['needed'] else ''}",
                ]
            )
    return table(["claim", "difference", "relative", "adjusted p", "verdict"], rows)


def rates(results: dict[str, Any], kind: str) -> list[str]:
    """How every agent drove."""
    found = {agent: one[kind] for agent, one in results["rates"].items()}
    metrics = list(found["baseline"])
    rows = [[f"`{agent}`", *(interval(one[metric]) for metric in metrics)] for agent, one in found.items()]
    return table(["agent", *(f"`{metric}`" for metric in metrics)], rows)


def draws(results: dict[str, Any]) -> list[str]:
    """How weights lie."""
    names = {
        "effective": "effective sample", "effective_scenarios": "of scenarios", "tilt": "tilt", "largest": "largest",
        "concentration": "draws from 5 %",
    }  # fmt: skip
    rows = [
        [f"`{agent}`", *(f"{one[name]:.2f}" for name in names)] for agent, one in results["draws"].items()
    ]
    return table(["agent", *names.values()], rows)


def rankings(results: dict[str, Any]) -> list[str]:
    """How alike methods rank scenarios."""
    rows = [
        [
            f"`{one['one']}`, `{one['other']}`",
            f"{one['rho']:+.2f}",
            f"{one['overlap']:.0%}",
            one["orthogonal"],
        ]
        for one in results["rankings"]
    ]
    return table(["methods", "rank correlation", "same among the top 5 %", "they are orthogonal"], rows)


def mean_q(results: dict[str, Any]) -> list[str]:
    """What choosing by the highest mean Q costs."""
    rows = [
        [f"`{name}`", "{:+.3f} [{:+.3f}, {:+.3f}]".format(one["difference"], *one["interval"])]
        for name, one in results["mean_q"].items()
    ]
    return table(["metric", "by mean Q minus by driving"], rows)


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
    """Keep, restore, or fill the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("keep", "restore", "table"))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.what == "table":
        PAGE.write_text(filled(PAGE.read_text(), json.loads((KEPT / RESULTS).read_text())))
    elif args.out is None:
        parser.error("the following arguments are required: --out")
    else:
        {"keep": keep, "restore": restore}[args.what](args.out)


if __name__ == "__main__":
    main()

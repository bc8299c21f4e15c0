"""Sealed files: edits and accidents are seen before they change a result, and edited files leave a mark."""

from __future__ import annotations

import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivax.api import evaluate
from drivax.cli import main
from drivax.errors import DataError
from drivax.evaluation.comparison import ComparisonPlan, compare
from drivax.evaluation.episode_table import Crash, EpisodeTable, Trajectories
from drivax.evaluation.result_tables import planners_table, transfer_table
from drivax.evaluation.runner import EvaluationConfig
from drivax.learning.config import TrainConfig
from drivax.learning.policies import open_policy
from drivax.learning.training_log import TrainingLog
from drivax.metrics.catalogue import EVENTS
from drivax.report.pages.comparison import comparison_text
from drivax.report.runs import read_runs
from drivax.seal import SEAL, allow_edited, check_seal, edited_files, seal, unseal
from drivax.studies.definition import StudyConfig
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder, policy_folder, zoo

EPISODES = 12
PLAN = ComparisonPlan(primary="success", secondary=("progress_ratio",), minimum_scenarios=5, resamples=100)


def evaluation(folder: Path, planner: str, seed: int = 0) -> Path:
    """An evaluation as ``run_evaluation`` writes it, with random results and a crash."""
    rng = np.random.default_rng(seed)
    ids = tuple(f"s{number}" for number in range(EPISODES))
    recordings = tuple(f"r{number // 2}" for number in range(EPISODES))
    keys = {"planner": (planner,), "dataset": ("d",), "seed": ("0",), "traffic": ("log",)}
    info: dict[str, Any] = {"planner": planner, "traffic": "log"}
    rollouts = Trajectories(
        rng.normal(size=(EPISODES, 3, 4)).astype(np.float32),
        rng.normal(size=(EPISODES, 2, 2)),
        np.zeros(EPISODES, int),
        {name: np.full(EPISODES, -1) for name in EVENTS},
    )  # fmt: skip
    table = EpisodeTable(
        None, planner, info,
        {name: values * EPISODES for name, values in keys.items()} | {"scenario_id": ids, "segment": recordings},
        {"success": rng.integers(0, 2, EPISODES).astype(float), "progress_ratio": rng.random(EPISODES)},
        (Crash("d", "s3", 17, "ValueError: no lane"),), rollouts,
    )  # fmt: skip
    counts: dict[str, Any] = {"episodes": EPISODES, "seed": 0}
    RunFolder.create(folder, EvaluationConfig(planner), kind="evaluation", **info, **counts)
    table.write(folder)
    return folder


def training(folder: Path) -> Path:
    """A finished training with one checkpoint, as the training loop leaves it."""
    run = RunFolder.create(folder, TrainConfig(), kind="training")
    with TrainingLog(run, "score", keep=2, patience=0) as log:
        log.start(None)
        for step in (100, 200):
            log.write(step, {"loss": 1 / step, "validation/vmax_score": step / 300})
            log.checkpoints.save(step, {"w": np.arange(3.0)}, step / 300)
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sealed")
    study = RunFolder.create(root / "study", StudyConfig(), kind="study", definition="c0de").path
    (study / "results.json").write_text('{"claims": []}')
    seal(study, "results.json")
    policy = shutil.copytree(policy_folder("zoo:ppo"), root / "policy")
    other = evaluation(root / "b", "other", 1)
    evaluations = {"evaluation": evaluation(root / "a", "ours"), "other": other}
    return evaluations | {"training": training(root / "training"), "study": study, "policy": policy}


def results(kind: str, folder: Path, other: Path) -> Any:
    """What drivax prints, draws or decides with the files of a folder."""
    if kind == "evaluation":
        tables, _ = read_runs([other, folder])
        comparison = compare(PLAN, (EpisodeTable.read(folder),), (EpisodeTable.read(other),))
        text = planners_table(tables, ["success", "progress_ratio"]).html()
        transfer = transfer_table(tables, "success").csv()
        crashes = [table.crashes for table in tables]
        return comparison_text(comparison), text, transfer, crashes, tables[1].settings, tables[1].info
    if kind == "training":
        (curves,) = read_runs([folder])[1]
        checkpoints, run = Checkpoints(folder / "checkpoints"), RunFolder.open(folder)
        values = {name: points.tolist() for name, points in curves.curves.items()}
        return values, curves.info, run.config(TrainConfig), checkpoints.best(), checkpoints.about(200)
    if kind == "policy":
        run = open_policy(folder)
        return run.info, run.config(TrainConfig)
    run = RunFolder.open(folder)
    check_seal(folder / "results.json")
    return run.info, run.config(StudyConfig), (folder / "results.json").read_text()


def outcome(kind: str, folder: Path, other: Path) -> tuple[object, str]:
    """Return the results, and the line of a DataError instead of them."""
    try:
        return results(kind, folder, other), ""
    except DataError as error:
        return None, str(error)


def bytes_by_class(content: bytes) -> dict[str, list[int]]:
    """Positions of the bytes of a text by class."""
    classes: dict[str, list[int]] = {}
    for position, byte in enumerate(content):
        letter = chr(byte)
        kind = (
            "digit"
            if letter.isdigit()
            else "letter"
            if letter.isalpha()
            else "space"
            if letter.isspace()
            else letter
        )
        classes.setdefault(kind if len(kind) > 1 else "punctuation", []).append(position)
    return classes


def text_files(folder: Path) -> list[Path]:
    suffixes = (".csv", ".json", ".jsonl", ".yaml")
    return sorted(
        file for file in folder.rglob("*") if file.suffix in suffixes and "arrays" not in file.parts
    )


def test_no_flip_in_a_text_file_changes_a_result_silently(folders):
    """Every class of bytes of every text file of an evaluation, a training, a policy and a study."""
    rng, flips, seen, silent = random.Random(0), 0, 0, []
    for kind in ("evaluation", "training", "policy", "study"):
        folder, other = folders[kind], folders["other"]
        expected, problem = outcome(kind, folder, other)
        assert expected is not None, problem
        for file in text_files(folder):
            content = file.read_bytes()
            for positions in bytes_by_class(content).values():
                for position in rng.sample(positions, min(9, len(positions))):
                    flipped = bytearray(content)
                    flipped[position] ^= 1 << rng.randrange(8)
                    file.write_bytes(flipped)
                    found, line = outcome(kind, folder, other)
                    flips, seen = flips + 1, seen + bool(line)
                    if found != expected and (not line or "\n" in line):
                        silent.append((str(file), position, line))
            file.write_bytes(content)
    print(f"{flips} flips, {seen} seen, {flips - seen - len(silent)} without effect, {len(silent)} silent")
    assert flips >= 500 and seen > flips / 2 and silent == []


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_edited_runs_are_refused_or_marked_in_every_table(tmp_path, capsys):
    ours, other = evaluation(tmp_path / "a", "ours"), evaluation(tmp_path / "b", "other", 1)
    plan = ["--primary", "success", "--secondary", "[progress_ratio]", "--minimum_scenarios", "5"]
    command = ["compare", str(ours), str(other), *plan, "--resamples", "100"]
    assert main(command) == 0
    clean = capsys.readouterr()
    assert "(edited)" not in clean.out and clean.err == ""
    edit(ours / "config.yaml", "start_step: 10", "start_step: 11")
    assert main(command) == 1
    refused = capsys.readouterr()
    assert refused.out == "" and refused.err.count("\n") == 1
    assert refused.err == (
        f"drivax: {ours}/config.yaml: changed since drivax wrote it; restore it, run the command again, or use the "
        "edited file with --edited\n"
    )
    edit(ours / "config.yaml", "start_step: 11", "start_step: 10  # ")
    page = tmp_path / "page.html"
    assert main([*command, "--edited", "--html", str(page)]) == 0
    marked = capsys.readouterr()
    assert f"A  ours (edited)  ({ours})" in marked.out and "B  other  (" in marked.out
    assert marked.err == f"drivax: made with edited files: {ours}/config.yaml\n"
    assert "ours (edited) against other" in page.read_text()
    assert f"edited after drivax wrote them:</b> {ours}/config.yaml" in page.read_text()
    report = ["report", str(other), str(ours), "--episodes", "0", "--out", str(tmp_path / "report.html")]
    assert main(report) == 1 and main([*report, "--edited"]) == 0
    assert "ours (edited)" in (tmp_path / "report.html").read_text()
    with allow_edited():
        tables, _ = read_runs([other, ours])
        assert "ours (edited)" in transfer_table(tables, "success").csv()


def test_edited_rollouts_and_added_or_deleted_crashes_are_seen(tmp_path):
    run = evaluation(tmp_path / "run", "ours")
    content = (run / "crashes.json").read_bytes()
    (run / "crashes.json").unlink()
    with pytest.raises(DataError, match=r"crashes\.json: is missing; restore it"):
        EpisodeTable.read(run)
    (run / "crashes.json").write_bytes(content)
    edit(run / "summary.json", '"ours"', '"theirs"')
    with pytest.raises(DataError, match=r"summary\.json: changed since drivax wrote it"):
        EpisodeTable.read(run)
    edit(run / "summary.json", '"theirs"', '"ours"')
    table = EpisodeTable.read(run)
    with (run / "trajectories.npz").open("ab") as file:
        file.write(b"x")
    with pytest.raises(DataError, match=r"trajectories\.npz: changed since drivax wrote it"):
        _ = table.trajectories
    with allow_edited():
        assert len(table.trajectories.ego) == EPISODES
        assert edited_files() == [str(run / "trajectories.npz")]
    crashes, seal_file = run / "crashes.json", run / SEAL
    crashes.unlink()
    seal(run, "crashes.json")
    assert json.loads(seal_file.read_text())["crashes.json"] is None and EpisodeTable.read(run).crashes == ()
    crashes.write_bytes(content)
    with pytest.raises(DataError, match=r"crashes\.json: was added since drivax wrote its folder"):
        EpisodeTable.read(run)


def as_earlier_version(run: Path) -> Path:
    """A run folder without its seal, and without the entry that says that it has one."""
    (run / SEAL).unlink()
    info = json.loads((run / "run.json").read_text())
    assert info.pop("sealed") is True
    (run / "run.json").write_text(json.dumps(info))
    return run


@pytest.mark.parametrize("kind", ["evaluation", "training", "policy", "study"])
@pytest.mark.parametrize("content", [None, "{}"])
def test_lost_seals_are_refused_or_marked(folders, tmp_path, kind, content):
    run = shutil.copytree(folders[kind], tmp_path / "run")
    (run / SEAL).unlink()
    problem = r"seal\.json: is missing; restore it, run the command again, or .* --edited"
    if content is not None:
        (run / SEAL).write_text(content)
        problem = problem.replace("is missing", r"lacks config\.yaml")
    with pytest.raises(DataError, match=problem):
        results(kind, run, folders["other"])
    with allow_edited():
        found = results(kind, run, folders["other"])
        assert edited_files() == [str(run / SEAL)]
        if kind == "evaluation":
            assert "ours (edited)" in found[0] and "ours (edited)" in found[1]
        RunFolder.open(run).note(step=3)  # writes a seal, without what it does not know
    with pytest.raises(DataError, match=r"seal\.json: lacks config\.yaml"):
        RunFolder.open(run)


def test_evaluations_need_the_entries_of_all_results(tmp_path):
    run = evaluation(tmp_path / "run", "ours")
    entries = json.loads((run / SEAL).read_text())
    for name in ("episodes.csv", "summary.json", "crashes.json", "trajectories.npz"):
        (run / SEAL).write_text(json.dumps({key: value for key, value in entries.items() if key != name}))
        with pytest.raises(DataError, match=rf"seal\.json: lacks {name}; restore it"):
            EpisodeTable.read(run)


ROW = "ours,d,s3,r1,0,log,"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda text: text.replace(ROW, "theirs,d,s3,r1,0,log,"), r"record 4: planner is 'theirs', not 'ours' as"),
        (lambda text: text.replace(ROW, "ours,d,s3,r1,7,log,"), r"record 4: seed is '7', not '0' as in run\.json"),
        (lambda text: text.replace(ROW, "ours,d,s3,r1,0,idm,"), r"record 4: traffic is 'idm', not 'log' as in run"),
        (lambda text: text.replace("d,s3,", "d,s2,"), r"record 4: scenario 's2' occurs twice"),
        (lambda text: text + "ours,d,s99,r9,0,log,1,0.5\n", r"record 13: has 13 rows, not 12 as in run\.json"),
        (lambda text: text[: text.rindex("ours,")], r"record 11: has 11 rows, not 12 as in run\.json"),
    ],
)  # fmt: skip
def test_rows_are_those_that_the_run_describes(tmp_path, change, problem):
    """Also where the seal is that of the edited file."""
    run = evaluation(tmp_path / "run", "ours")
    file = run / "episodes.csv"
    text = file.read_text()
    assert change(text) != text
    file.write_text(change(text))
    seal(run, file.name)
    with pytest.raises(DataError, match=rf"episodes\.csv: {problem}.*; restore it, .* --edited"):
        EpisodeTable.read(run)
    with allow_edited():
        assert EpisodeTable.read(run).name == "ours (edited)"


def test_rows_of_other_programs_are_compared_as_far_as_the_run_describes_them(tmp_path):
    run = evaluation(tmp_path / "run", "ours")
    (run / SEAL).unlink()
    file = run / "run.json"
    file.write_text('{"kind": "evaluation", "data": [{"hash": null, "scenarios": 10}]}')
    with pytest.raises(
        DataError, match=r"record 11: scenario 's10' is one more than the 10 of the set in run\.json"
    ):
        EpisodeTable.read(run)
    file.write_text('{"kind": "evaluation"}')
    edit(run / "episodes.csv", "ours,d,s3", "ours,d,s2")
    assert len(EpisodeTable.read(run)) == EPISODES


def test_folders_of_earlier_versions_and_unfinished_trainings_open(tmp_path):
    run = as_earlier_version(evaluation(tmp_path / "run", "ours"))
    edit(run / "episodes.csv", "ours,d,s0", "ours,d,s00")
    assert EpisodeTable.read(run).name == "ours"
    folder = RunFolder.open(training(tmp_path / "training"))
    with pytest.raises(DataError, match=r"metrics\.jsonl: changed"):
        edit(folder.metrics, "100", "101")
        folder.read_metrics()
    edit(folder.metrics, "101", "100")
    with pytest.raises(KeyboardInterrupt), TrainingLog(folder, "score", 2, 0) as log:
        log.start(200)
        log.write(300, {"loss": 0.5})
        assert len(folder.read_metrics()) == 3
        raise KeyboardInterrupt
    assert "metrics.jsonl" not in json.loads((folder.path / SEAL).read_text())
    assert len(folder.read_metrics()) == 3 and folder.config(TrainConfig) == TrainConfig()


def test_edits_are_noted_in_later_runs_and_stay_edits(tmp_path):
    policy = RunFolder.create(tmp_path / "policy", TrainConfig(), kind="policy")
    edit(policy.path / "run.json", '"policy"', '"policy" ')
    with allow_edited():
        opened = RunFolder.open(policy.path).note(step=3)
        made = RunFolder.create(tmp_path / "made", EvaluationConfig("policy"))
        assert made.info["edited"] == edited_files() == [str(policy.path / "run.json")]
    assert opened.info["step"] == 3
    with pytest.raises(DataError, match="changed"):
        RunFolder.open(policy.path)
    with allow_edited(False):
        RunFolder.open(made.path)
        assert edited_files() == [str(policy.path / "run.json")]
    assert edited_files() == []


def test_damaged_seals_are_refused_in_one_line(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("a")
    for content in (b"", b"{", b"[]", b"3", b"\xff", b"[" * 100_000):
        (tmp_path / SEAL).write_bytes(content)
        with pytest.raises(DataError, match=r"seal\.json: is damaged; restore it") as caught:
            check_seal(file)
        assert "\n" not in str(caught.value)
        with allow_edited():
            check_seal(file)
            assert edited_files() == [str(tmp_path / SEAL)]
    (tmp_path / SEAL).write_text('{"a.txt": 5}')
    with pytest.raises(DataError, match=r"a\.txt: changed"):
        check_seal(file)
    seal(tmp_path, "a.txt", "b.txt")
    # The digest of "a" by sha256sum.
    digest = "ca978112ca1bbdcafac231b39a23dc4da786eff8147c4e72b9807785afee48bb"
    assert json.loads((tmp_path / SEAL).read_text()) == {"a.txt": digest, "b.txt": None}
    unseal(tmp_path, "a.txt")
    assert json.loads((tmp_path / SEAL).read_text()) == {"b.txt": None}


@pytest.mark.parametrize("name", [SEAL, "a.txt"])
def test_seals_and_sealed_files_that_are_no_regular_files_are_refused_in_one_line(tmp_path, name):
    """Reading a pipe or ``/dev/zero`` would not end."""
    file, path = tmp_path / "a.txt", tmp_path / name
    (tmp_path / SEAL).write_text('{"a.txt": "5"}')
    for create in (os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero")):
        path.unlink(missing_ok=True)
        create(path)
        with allow_edited(), pytest.raises(DataError, match=r"not a regular file\); restore it") as caught:
            check_seal(file)
        assert caught.value.file == path
        if path.is_dir():
            path.rmdir()


def test_large_seals_are_refused_before_they_are_read(tmp_path):
    (tmp_path / SEAL).touch()
    os.truncate(tmp_path / SEAL, 20 << 30)  # sparse
    with pytest.raises(DataError, match=r"seal\.json: has 21 GB, more than the 1\.0 MB"):
        check_seal(tmp_path / "a.txt")
    (tmp_path / SEAL).rename(tmp_path / "a.txt")
    (tmp_path / SEAL).write_text('{"a.txt": "5"}')
    with pytest.raises(DataError, match=r"a\.txt: is damaged \(larger than any sealed file\)"):
        check_seal(tmp_path / "a.txt")


@pytest.mark.parametrize("name", zoo())
def test_policies_of_the_zoo_are_sealed(name):
    entries = json.loads((policy_folder(name) / SEAL).read_text())
    assert sorted(entries) == ["config.yaml", "policy.npz", "run.json"]
    for file in entries:
        check_seal(policy_folder(name) / file)


def test_resumed_training_deletes_what_its_end_did_not(tmp_path):
    """A kill between writing a checkpoint and deleting the one that it supersedes leaves both."""
    run = RunFolder.open(training(tmp_path / "run"))
    with TrainingLog(run, "score", keep=1, patience=0) as log:
        log.start(200)
        assert log.checkpoints.steps() == [200]


def test_python_marks_evaluations_of_edited_policies(tmp_path):
    policy = shutil.copytree(policy_folder("zoo:aggressive"), tmp_path / "policy")
    data = tmp_path / "set"
    generate(data, 1, 0, Generation(workers=0))
    assert evaluate(policy, data).planner == "policy"
    info = json.loads((policy / "run.json").read_text())
    (policy / "run.json").write_text(json.dumps({**info, "edited": ["a/config.yaml"]}))
    seal(policy, "run.json")
    assert evaluate(policy, data).planner == "policy (edited)"


def test_planners_along_the_route_are_marked(tmp_path):
    generate(tmp_path / "set", 1, 0, Generation(workers=0))
    run = tmp_path / "run"
    assert main(["evaluate", "--planner", "zoo:sac", "--data", str(tmp_path / "set"), "--out", str(run)]) == 0
    table = EpisodeTable.read(run)
    assert table.name == table.planner == table.keys["planner"][0] == "sac (route)"
    assert "sac (route)" in planners_table([table], ["success"]).csv()

"""Text of the demo's results; ``end_to_end/test_demo.py`` runs it."""

from pathlib import Path

import pytest

from drivax.errors import DataError, UsageError
from drivax.stats.intervals import Interval
from drivax.studies.demo import DemoResult, run_demo


@pytest.mark.parametrize(
    "name", ["sets", "training", "training/policy", "evaluation/expert", "report.html", "demo.json"]
)
def test_demo_refuses_links_in_its_folder(tmp_path, name):
    out, elsewhere = tmp_path / "demo", tmp_path / "elsewhere"
    (out / name).parent.mkdir(parents=True)
    (out / name).symlink_to(elsewhere)
    with pytest.raises(DataError, match=f"{name}: is a symbolic link; replace the link"):
        run_demo(out, overwrite=True, log=pytest.fail)


def test_demo_refuses_a_file_and_a_folder_with_content(tmp_path):
    file = tmp_path / "file"
    file.touch()
    for out, overwrite, text in (
        (file, True, "file: output is a file; name a folder to write"),
        (tmp_path, False, "output folder already exists; choose another or pass --overwrite"),
    ):
        with pytest.raises(UsageError, match=text):
            run_demo(out, overwrite=overwrite, log=pytest.fail)
    assert list(tmp_path.iterdir()) == [file]


def test_difference_of_a_single_scenario_has_no_interval():
    difference = {"success": Interval(0.5, None, None, 1).as_dict()}
    text = DemoResult(Path("report.html"), [], {"idm": difference}, {"report": 1.0}).text()
    assert "policy - idm: success +0.500 [–, –] over 1 scenarios" in text

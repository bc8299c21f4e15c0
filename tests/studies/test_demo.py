"""Text of the demo's results; ``end_to_end/test_demo.py`` runs it."""

from pathlib import Path

from drivax.stats.intervals import Interval
from drivax.studies.demo import Demo


def test_difference_of_a_single_scenario_has_no_interval():
    difference = {"success": Interval(0.5, None, None, 1).as_dict()}
    text = Demo(Path("report.html"), [], {"idm": difference}, {"report": 1.0}).text()
    assert "policy - idm: success +0.500 [–, –] over 1 scenarios" in text

"""Store a run of the demo, and put its results into its page and the README.

make demo
python -m experiments.demo [--run demo]    (without a run: the stored one)
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from experiments.learning.tables import interval, table
from experiments.repository import DOCS, RESULTS, ROOT, fill_places

PAGES = (DOCS / "results" / "demo.md", ROOT / "README.md")
COLUMNS = {
    "success": "success", "accuracy": "accuracy", "at_fault_collision": "at-fault collision",
    "offroad": "off the road", "vmax_score": "V-Max score",
}  # fmt: skip


def blocks(result: dict[str, Any]) -> dict[str, list[str]]:
    """Return the tables by the names of their places."""
    rows = [
        [f"`{summary['planner']}`", *(interval(summary["metrics"][metric]) for metric in COLUMNS)]
        for summary in result["summaries"]
    ]
    differences = [
        [f"`{planner}`", f"`{metric}`", interval(values, signed=True), str(values["n"])]
        for planner, metrics in result["policy_minus"].items()
        for metric, values in metrics.items()
    ]
    stages = [[stage, f"{seconds:.0f} s"] for stage, seconds in result["stages_s"].items()]
    return {
        "planners": table(["planner", *COLUMNS.values()], rows),
        "differences": table(["policy minus", "metric", "difference", "n"], differences),
        "stages": table(["stage", "time"], [*stages, ["total", f"{sum(result['stages_s'].values()):.0f} s"]]),
    }


def fill(text: str, result: dict[str, Any]) -> str:
    """Return the text of a page with the tables in their places."""
    return fill_places(text, "demo.py", blocks(result))


def main() -> None:
    """Store a run, and write the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, help="folder that `drivax demo` wrote")
    args = parser.parse_args()
    stored = RESULTS / "demo.json"
    if args.run is not None:
        result = json.loads((args.run / "demo.json").read_text()) | {"command": "drivax demo"}
        stored.write_text(json.dumps(result, indent=1) + "\n")
    for page in PAGES:
        page.write_text(fill(page.read_text(), json.loads(stored.read_text())))


if __name__ == "__main__":
    main()

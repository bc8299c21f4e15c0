"""Measure sizes and times of the encoders on the ``optimal`` observation and write them to their page.

python -m experiments.speed.encoders            # counts and times everything; needs a quiet machine
python -m experiments.speed.encoders --counts   # numbers of parameters only
python -m experiments.speed.encoders --table    # write the stored result to the page
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from drivax.studies.bench import bench_encoders
from experiments.repository import DOCS, RESULTS

RESULT = RESULTS / "encoders.json"
PAGE = DOCS / "algorithms" / "encoders.md"
#: The table stands between these lines of the page.
BEGIN, END = "<!-- sizes: python -m experiments.speed.encoders --table -->\n", "<!-- end of sizes -->\n"


def table(result: dict[str, Any]) -> str:
    """Return a Markdown table. Without times it has float32 rows only, since sizes do not depend on the type."""
    rows = result["rows"]
    timed = all("gradient_us" in row for row in rows)
    if not timed:
        lines = [
            f"| {row['encoder']} | {row['parameters']:,} | {row['width']} |"
            for row in rows
            if row["dtype"] == "float32"
        ]
        return "\n".join(["| encoder | parameters | width |", "|---|---:|---:|", *lines]) + "\n"
    batches = list(rows[0]["forward_us"])
    heads = [f"forward, batch {batch} (us)" for batch in batches]
    heads.append(f"forward and backward, batch {batches[-1]} (us)")
    lines = [f"| encoder | computes in | parameters | width | {' | '.join(heads)} |"]
    lines.append("|---|---|" + "---:|" * (2 + len(heads)))
    for row in rows:
        times = [*row["forward_us"].values(), row["gradient_us"]]
        cells = [row["encoder"], row["dtype"], f"{row['parameters']:,}", str(row["width"])]
        lines.append(f"| {' | '.join([*cells, *(f'{time:,.1f}' for time in times)])} |")
    return "\n".join([*lines, "", f"Per observation, on: {result['device']}."]) + "\n"


def into_page(result: dict[str, Any]) -> str:
    """Write the table to the page and return it."""
    text, page = table(result), PAGE.read_text()
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")
    return text


def main() -> None:
    """Measure, store and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--counts", action="store_true", help="time nothing")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    args = parser.parse_args()
    if not args.table:
        RESULT.write_text(json.dumps(bench_encoders(times=not args.counts), indent=1) + "\n")
    print(into_page(json.loads(RESULT.read_text())))


if __name__ == "__main__":
    main()

"""Measure every speed that docs show, one script after the other, and write results and tables.

    python -m experiments.speed --data SET --against TREE [--only NAME ...]

SET has at least 4,096 scenarios; TREE is a checkout of the earlier state (``experiments.speed.ratios``). Nothing else
may run on the machine; all of it takes about an hour. ``experiments.speed.commands`` compares with another state, so it
is run by itself.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from experiments.repository import ROOT

#: Arguments of each script after its name, and whether a second call puts the result into a page.
SCRIPTS = {
    "ratios": (("--data", "DATA", "--against", "TREE"), False),
    "simulator": (("--data", "DATA"), True),
    "evaluation": (("--data", "DATA"), True),
    "training": (("--data", "DATA"), False),
    "offline": (("--data", "DATA"), True),
    "convert": ((), False),
    "encoders": ((), False),
}


def main() -> None:
    """Run the scripts; stop at the first that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--against", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=SCRIPTS, default=tuple(SCRIPTS))
    args = parser.parse_args()
    values = {"DATA": str(args.data.resolve()), "TREE": str(args.against.resolve())}
    for name in args.only:
        words, has_table = SCRIPTS[name]
        # The encoders' script always writes.
        write = () if name == "encoders" else ("--write",)
        calls = [(*(values.get(word, word) for word in words), *write)] + [("--table",)] * has_table
        for call in calls:
            subprocess.run([sys.executable, "-m", f"experiments.speed.{name}", *call], cwd=ROOT, check=True)


if __name__ == "__main__":
    main()

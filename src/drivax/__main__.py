"""``python -m drivax`` is the command line."""

from __future__ import annotations

import sys

from drivax.cli import main

if __name__ == "__main__":
    sys.exit(main())

"""Build hook: with ``DRIVAX_WHEEL_TAG`` set, compile the kernels into the wheel and give it this platform's tag."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class NativeWheel(BuildHookInterface):
    """Without the variable the wheel is pure Python, whatever ``make native`` has left in the source tree."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and add the library to the wheel."""
        tag = os.environ.get("DRIVAX_WHEEL_TAG")
        if not tag:
            return
        subprocess.run([sys.executable, str(Path(self.root) / "native" / "build.py")], check=True)
        build_data["artifacts"].append("src/drivax/kernels/libdrivax.so")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag}"

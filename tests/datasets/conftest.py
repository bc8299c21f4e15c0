"""Hand-made records of motion data (``samples``) and a writer of TFRecords."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from datasets.samples import scenariomax, womd_example, womd_scenario


@pytest.fixture(scope="session")
def wire() -> SimpleNamespace:
    """The encoders of the samples and their hand-made scenes."""
    names = vars(womd_scenario) | vars(womd_example) | {"scenariomax": scenariomax.example}
    return SimpleNamespace(**{name: value for name, value in names.items() if not name.startswith("_")})


@pytest.fixture
def write_records(tmp_path):
    """Writes payloads as a TFRecord file."""

    def write(name: str, *payloads: bytes):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"".join(womd_scenario.frame(payload) for payload in payloads))
        return path

    return write


@pytest.fixture
def hide_packages(monkeypatch):
    """A function that makes packages look as if they were not installed."""

    def hide(*packages: str) -> None:
        loaded = [
            name for name in sys.modules if name.startswith(tuple(f"{package}." for package in packages))
        ]
        for name in (*packages, *loaded):
            monkeypatch.setitem(sys.modules, name, None)

    return hide

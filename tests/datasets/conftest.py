"""Hand-made records of motion data (``samples``) and a writer of TFRecords."""

from __future__ import annotations

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

"""Words that the project does not use: the table is ``wording.yaml``."""

from __future__ import annotations

import io
import keyword
import re
import subprocess
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parent.parent
_YAML = yaml.safe_load((REPOSITORY / "tests" / "wording.yaml").read_text())
TABLE: list[dict[str, Any]] = _YAML["rows"]
#: Records of the past keep the words of their day.
HISTORY = ("docs/log/", "docs/decisions/")
SUFFIXES = {".py", ".pyi", ".md", ".js", ".css", ".html", ".template"}


def _files() -> list[Path]:
    roots = ["src", "docs", "README.md", "tests"]
    command = ["git", "-C", str(REPOSITORY), "ls-files", "-co", "--exclude-standard", *roots]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.skip("not a git checkout")
    names = [name for name in result.stdout.splitlines() if not name.startswith(HISTORY)]
    files = [REPOSITORY / name for name in names]
    return [
        file for file in files if file.suffix in SUFFIXES and file.is_file() and "wording" not in file.name
    ]


@cache
def prose(file: Path, text: str) -> list[tuple[int, str]]:
    """Numbered lines in which words are searched: of tests only names and first lines of docstrings."""
    lines = list(enumerate(text.splitlines(), start=1))
    if "tests" in file.relative_to(REPOSITORY).parts[:1]:
        lines = [(number, line) for number, line in lines if re.match(r'\s*(def test_|class |""")', line)]
    return [(number, line if file.suffix == ".md" else line.replace("_", " ")) for number, line in lines]


@cache
def names(text: str) -> list[tuple[int, str]]:
    """Numbered identifiers of Python code, attributes aside."""
    tokens, previous = [], ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME and previous != "." and not keyword.iskeyword(token.string):
            tokens.append((token.start[0], token.string))
        previous = token.string
    return tokens


def violations(row: dict[str, Any], file: Path, text: str) -> list[str]:
    """Places in a file where a word of a row stands."""
    place = str(file.relative_to(REPOSITORY))
    if not place.startswith(tuple(row.get("in", [""]))) or place.startswith(tuple(row.get("except", ["\0"]))):
        return []
    words = "|".join(row["not"])
    if row.get("names"):
        hits = (
            [(n, name) for n, name in names(text) if re.fullmatch(words, name)]
            if file.suffix == ".py"
            else []
        )
    else:
        found = (
            (number, re.search(rf"\b(?:{words})\b", line, re.IGNORECASE))
            for number, line in prose(file, text)
        )
        hits = [(number, match[0]) for number, match in found if match]
    return [f"{place}:{number}: {word!r}, write: {row['write']}" for number, word in hits]


def test_words_of_the_table_are_not_used():
    texts = {file: file.read_text(encoding="utf-8") for file in _files()}
    assert texts
    hits = [hit for file, text in texts.items() for row in TABLE for hit in violations(row, file, text)]
    assert not hits, "\n".join(hits[:50])


@pytest.mark.parametrize(
    ("suffix", "text", "count"),
    [
        (".md", "It stands beside the road.", 1),
        (".py", "besides = 1  # next to it\n", 0),
        (".py", "def f():\n    return told_twice\n", 1),
        (".py", "found = 1\nx.found = found\n", 2),
        (".py", 'def f():\n    """See :class:`A`."""\n', 1),
        (".py", 'def f():\n    """Return what is ahead."""\n', 1),
    ],
)
def test_the_search_finds_words_and_names(suffix: str, text: str, count: int):
    file = REPOSITORY / "src" / "drivax" / f"example{suffix}"
    assert len([hit for row in TABLE for hit in violations(row, file, text)]) == count

"""The documentation is true: its Python runs, its imports are public, its commands exist, its links lead somewhere."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
import sys
import types
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from drivax import cli
from drivax.curation.methods import METHODS

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")])
_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<body>.*?)^(?P=indent)```", re.M | re.S)
_FILE = re.compile(r"# (?P<file>[\w.]+\.(py|yaml))\n")
_IMPORT = re.compile(
    r"^ *(?:from (?P<room>drivax[\w.]*) import (?P<names>\([^)]*\)|[^\n#]*)|import (?P<module>drivax[\w.]*))",
    re.M,
)
#: Packages below ``drivax.ROOM`` that users import from.
SUB_ROOMS = [
    *(
        f"drivax.datasets.{name}"
        for name in ("argoverse", "export", "nuplan", "nuscenes", "scenarionet", "womd")
    ),
    *(f"drivax.scenario.{name}" for name in ("bank", "build", "select")),
    *(f"drivax.synthetic.{name}" for name in ("events", "expert", "roads", "traffic")),
    "drivax.learning.algorithms",
    "drivax.simulator.traffic",
]
#: Code for users: pages except records of the past, and examples.
USER_CODE = [
    *(page for page in PAGES if page.parent.name not in ("decisions", "log")),
    *sorted((REPOSITORY / "examples").glob("*.py")),
]
_LINK = re.compile(r"!?\[[^\]]*\]\((?P<target>[^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(REPOSITORY)}:{self.line}"


def blocks(page: Path, *languages: str) -> list[Block]:
    text = page.read_text()
    found = []
    for match in _FENCE.finditer(text):
        if match["language"] in languages:
            lines = match["body"].splitlines()
            body = "\n".join(line.removeprefix(match["indent"]) for line in lines)
            found.append(
                Block(page, text.count("\n", 0, match.start("body")) + 1, match["language"], body + "\n")
            )
    return found


def commands(block: Block) -> list[list[str]]:
    """The ``drivax`` commands of a shell block, as lists of words."""
    text = block.text.replace("\\\n", " ")
    lines = (line.strip().removeprefix("$ ") for line in text.splitlines())
    return [shlex.split(line, comments=True) for line in lines if re.match(r"drivax\b", line)]


@cache
def help_of(command: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert cli.main([command, "--help"]) == 0, f"drivax {command} --help fails"
    return out.getvalue()


#: Pages that take more than a few seconds; what they say is tested quickly elsewhere.
SLOW_PAGES = (
    "docs/guide/custom.md", "docs/guide/dynamics.md", "docs/guide/evaluate.md", "docs/guide/gymnasium.md",
    "docs/guide/planners.md", "docs/guide/rewards.md", "docs/guide/traffic.md", "docs/start/own_loop.md",
)  # fmt: skip
PYTHON_PAGES = [
    pytest.param(page, marks=pytest.mark.slow) if str(page.relative_to(REPOSITORY)) in SLOW_PAGES else page
    for page in PAGES
    if blocks(page, "python")
]
SHELL_BLOCKS = [block for page in PAGES for block in blocks(page, "bash", "console", "sh") if commands(block)]


def test_pages_are_found():
    assert REPOSITORY / "README.md" in PAGES
    assert SHELL_BLOCKS


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_python_blocks_of_each_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Blocks of a page share their names, as a reader who types them in order has them.

    A block that begins with the name of a file, as ``# my_terms.py``, is that file in the folder of the reader.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    module = types.ModuleType("page")  # dataclasses look their module up
    monkeypatch.setitem(sys.modules, "page", module)
    for block in blocks(page, "python", "yaml"):
        if name := _FILE.match(block.text):
            (tmp_path / name["file"]).write_text(block.text)
            continue
        if block.language == "yaml":
            continue
        code = compile("\n" * (block.line - 1) + block.text, str(page), "exec", dont_inherit=True)
        exec(code, module.__dict__)


@pytest.mark.parametrize("file", USER_CODE, ids=lambda file: str(file.relative_to(REPOSITORY)))
def test_imports_are_public_names_of_rooms(file: Path):
    for match in _IMPORT.finditer(file.read_text()):
        name = match["room"] or match["module"]
        assert name.count(".") <= 1 or name in SUB_ROOMS, f"import from {name.rpartition('.')[0]}: {match[0]}"
        room = importlib.import_module(name)
        for imported in re.findall(r"\w+", match["names"] or ""):
            is_room = (Path(room.__file__ or "").parent / imported / "__init__.pyi").exists()
            assert imported in room.__all__ or is_room, f"{name} does not export {imported}: {match[0]}"


@pytest.mark.parametrize("block", SHELL_BLOCKS, ids=lambda block: block.place)
def test_commands_in_docs_exist_with_their_flags(block: Block):
    for words in commands(block):
        flags = [word.split("=")[0] for word in words[1:] if word.startswith("--")]
        if len(words) == 1 or words[1] in ("--help", "--version"):
            continue
        assert words[1] in cli.COMMANDS, f"{block.place}: there is no command {words[1]}"
        for flag in flags:
            dotted = "." in flag and cli.COMMANDS[words[1]].overrides
            known = flag in ("--debug", "--edited", "--help") or re.search(
                rf"(?<![\w-]){flag}(?![\w-])", help_of(words[1])
            )
            setting = flag.removeprefix("--")
            if words[1] == "curate" and ":" in words[2]:  # the page defines the reader's own method
                page = REPOSITORY / block.place.split(":")[0]
                known = known or re.search(rf"^    {setting}: ", page.read_text(), re.M)
            elif words[1] == "curate":
                known = known or hasattr(METHODS[words[2]].config, setting)
            assert dotted or known, f"{block.place}: drivax {words[1]} has no {flag}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page: Path):
    text = _FENCE.sub("", page.read_text())
    for match in _LINK.finditer(text):
        target = match["target"].split("#")[0]
        if target and "://" not in target and not target.startswith("mailto:"):
            assert (page.parent / target).exists(), f"{page.relative_to(REPOSITORY)}: {match['target']}"


def test_readme_is_short():
    assert len((REPOSITORY / "README.md").read_text().splitlines()) < 200

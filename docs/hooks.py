"""Pages that mkdocs generates: the API reference, lists of decisions and log entries, and files of the root."""

from __future__ import annotations

import ast
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

_DOCS = Path(__file__).resolve().parent
_PACKAGE = _DOCS.parent / "src" / "drivax"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    index = [
        "# API reference",
        "",
        _docstring(_PACKAGE / "__init__.py"),
        "",
        "| module | content |",
        "|---|---|",
    ]
    modules = _public_modules()
    names = {name: public_names(file, name) for name, file in sorted(modules.items())}
    # A name that several packages export is documented in the innermost one; the others link to it.
    home = {name: package for package in sorted(names, key=len) for name in names[package]}
    for package, exported in names.items():
        summary = _docstring(modules[package].with_suffix(".py"))
        own = [f"::: {name}" for name in exported if home[name] == package]
        links = [f"[`{name.rpartition('.')[2]}`][{name}]" for name in exported if home[name] != package]
        parts = [f"# {package}", summary, *([f"Also exported: {', '.join(links)}."] if links else []), *own]
        files.append(File.generated(config, f"reference/{package}.md", content="\n\n".join(parts) + "\n"))
        index.append(f"| [`{package}`]({package}.md) | {summary.splitlines()[0]} |")
    files.append(File.generated(config, "reference/index.md", content="\n".join(index) + "\n"))
    for name, folder, title in (("decisions", "decisions", "Decisions"), ("log", "log", "Experiment log")):
        rows = [
            f"- [{_title(page)}](../{folder}/{page.name})" for page in sorted((_DOCS / folder).glob("*.md"))
        ]
        content = "\n".join([f"# {title}", "", *rows]) + "\n"
        files.append(File.generated(config, f"project/{name}.md", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Show a file of the repository's root in place of the page that links to it, with links that hold here."""
    uri = page.file.src_uri
    if uri in ("project/changelog.md", "project/contributing.md", "project/credits.md"):
        root = _DOCS.parent / f"{Path(uri).stem.upper()}.md"
        return root.read_text(encoding="utf-8").replace("](docs/", "](../")
    return markdown


def _public_modules() -> dict[str, Path]:
    """Return the files that list public names: the stubs of packages, and modules with ``__all__`` next to them."""
    stubs = {
        ".".join(file.parent.relative_to(_PACKAGE.parent).parts): file
        for file in _PACKAGE.rglob("__init__.pyi")
    }
    files = {f"{_PACKAGE.name}.{file.stem}": file for file in _PACKAGE.glob("[a-z]*.py")}
    return stubs | {name: file for name, file in files.items() if public_names(file, name)}


def public_names(file: Path, module: str) -> list[str]:
    """Return the full names that a package exports, from its stub, or those in ``__all__`` of a module."""
    names = []
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if file.suffix == ".pyi" and isinstance(node, ast.ImportFrom):
            names += [f"{module}.{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            names += [f"{module}.{name}" for name in ast.literal_eval(node.value)]
    return names


def _docstring(module: Path) -> str:
    return ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""


def _title(page: Path) -> str:
    return page.read_text(encoding="utf-8").split("\n", 1)[0].lstrip("# ")

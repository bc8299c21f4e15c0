"""The zoo: trained policies that come with the package, each under a name, ``zoo:NAME``."""

from __future__ import annotations

from pathlib import Path

from drivax.errors import UsageError

#: What names of the zoo begin with.
ZOO = "zoo:"
_FOLDER = Path(__file__).resolve().parent.parent / "zoo"


def zoo() -> list[str]:
    """All names, ``zoo:`` included."""
    return sorted(ZOO + path.parent.name for path in _FOLDER.glob("*/run.json"))


def policy_folder(name: str | Path) -> Path:
    """The folder that a name stands for: of a policy of the zoo, or the path itself.

    Raises:
        UsageError: The zoo has no such policy.
    """
    if not str(name).startswith(ZOO):
        return Path(name)
    if name not in zoo():
        raise UsageError(f"there is no policy {str(name)!r} in the zoo", cure=f"use {', '.join(zoo())}")
    return _FOLDER / str(name).removeprefix(ZOO)


def is_policy(name: str | Path) -> bool:
    """Whether a name means a trained policy: it begins with ``zoo:``, or a folder is called so."""
    return str(name).startswith(ZOO) or Path(name).is_dir()

"""Names that a stranger may write into a file: dangerous, foreign, or of drivax but no component."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import pkgutil
from types import ModuleType

import drivax
from drivax.errors import UsageError

#: Modules that leave a trace when they are imported, at the places where a run folder could carry them.
CARRIED = ("good_policy.extra", "good_policy", "carried", "drivaxx.tasks", "drivax_extra", "zoo.extra")
MODULES = (
    "os", "posix", "subprocess", "builtins", "sys", "shutil", "importlib", "runpy", "pickle", "ctypes", "socket",
    "webbrowser", "pdb", "code", "antigravity", "this", "numpy", "jax", "yaml", "cattrs", "tyro", "__main__", "site",
)  # fmt: skip
OBJECTS = (
    "thing", "abort", "system", "Popen", "exec", "eval", "exit", "rmtree", "import_module", "run_path", "loads",
    "test.main",
)  # fmt: skip
#: In drivax, but defined elsewhere, or nothing that a configuration names.
INSIDE = (
    "drivax.cli:main", "drivax.cli:os.dup2", "drivax.errors:importlib.import_module", "drivax.plugins:sys.exit",
    "drivax.plugins:sys", "drivax.plugins:find_named", "drivax.plugins:Path.unlink", "drivax.files:shutil.rmtree",
    "drivax.tracking.run_folder:os.abort", "drivax.tracking.run_folder:subprocess.run", "drivax.settings:load",
    "drivax.tracking.run_folder:versions", "drivax.api:generate", "drivax.no_such_module:f", "drivax:__version__",
)  # fmt: skip


def modules() -> list[ModuleType]:
    """All modules of drivax, but for those of extras that are not installed."""
    found = [drivax]
    for info in pkgutil.walk_packages(drivax.__path__, "drivax."):
        with contextlib.suppress(ImportError, UsageError):
            if not info.name.endswith("__main__"):
                found.append(importlib.import_module(info.name))
    return found


def hostile_names() -> list[str]:
    """All of them, and everything in the modules of drivax that other packages define."""
    names = [f"{module}:{thing}" for module in (*CARRIED, *MODULES) for thing in OBJECTS]
    for module in modules():
        for name, thing in sorted(vars(module).items()):
            origin = getattr(thing, "__name__" if inspect.ismodule(thing) else "__module__", None)
            if name.isidentifier() and isinstance(origin, str) and origin.partition(".")[0] != "drivax":
                names.append(f"{module.__name__}:{name}")
    return [*names, *INSIDE]

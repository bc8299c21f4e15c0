"""Stamp of a compiled library, which says what it was built for: appended by the build, and checked before loading.

``native/build.py`` runs this file by its path: it needs only JAX and the standard library.
"""

from __future__ import annotations

import hashlib
import json
import re
import sysconfig
from pathlib import Path

import jax.ffi

_VERSION = re.compile(r"#define XLA_FFI_API_MAJOR (\d+)")


def stamp(sources: Path) -> dict[str, str]:
    """Return platform, major version of XLA's foreign function interface, and hash of the sources if they exist."""
    header = Path(jax.ffi.include_dir(), "xla", "ffi", "api", "c_api.h")
    values = {"platform": sysconfig.get_platform(), "XLA FFI": "".join(_VERSION.findall(header.read_text()))}
    if (sources / "build.py").is_file():
        digest = hashlib.sha256()
        for path in sorted([*sources.glob("*.cc"), *sources.glob("*.h"), sources / "build.py"]):
            if not path.name.startswith("."):  # files of editors
                digest.update(path.read_bytes())
        values["sources"] = digest.hexdigest()[:12]
    return values


def append_stamp(library: bytes, values: dict[str, str]) -> bytes:
    """Return a library with its stamp and, as the last line, the SHA-256 of everything before it."""
    stamped = library + b"\n" + json.dumps(values).encode()
    return stamped + b"\n" + hashlib.sha256(stamped).hexdigest().encode()


def read_stamp(library: bytes) -> dict[str, str] | None:
    """Return the stamp of a library; None if it has none or is incomplete."""
    stamped, _, digest = library.rpartition(b"\n")
    if hashlib.sha256(stamped).hexdigest().encode() != digest:
        return None
    return json.loads(stamped.rpartition(b"\n")[2])

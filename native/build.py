"""Compile the kernels into ``src/drivax/kernels``; a C++17 compiler (``CXX``, default ``c++``) for x86-64 Linux.

    python native/build.py [--strict] [--sanitize]

Each kernel is compiled once per instruction set, and once for its binding to XLA. No option allows other results
(fast-math) or needs this processor. ``--strict``, for the tests, makes warnings errors: those of newer compilers must
not break the builds of users. ``--sanitize`` builds with AddressSanitizer and UndefinedBehaviorSanitizer.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax.ffi

SOURCES = Path(__file__).resolve().parent
LIBRARY = SOURCES.parent / "src" / "drivax" / "kernels" / "libdrivax.so"
#: drivax itself may not be installed yet.
_library = runpy.run_path(str(LIBRARY.with_name("library.py")))
#: Flags of each target, and floats per vector.
TARGETS = {
    "sse42": (("-msse4.2",), 4),
    "avx2": (("-mavx2", "-mfma"), 8),
    "avx512": (
        (
            "-mavx512f",
            "-mavx512dq",
            "-mavx512bw",
            "-mavx512vl",
            "-mavx2",
            "-mfma",
            "-mprefer-vector-width=512",
        ),
        16,
    ),
}
FLAGS = (
    "-std=c++17", "-O3", "-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wextra",
    "-Wno-psabi", "-Wno-missing-field-initializers",
)  # fmt: skip
STRICT = ("-Werror",)
SANITIZERS = ("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-g")


def compiler() -> str:
    """Return the compiler, or end with one line."""
    name = os.environ.get("CXX", "c++")
    if shutil.which(name) is None:
        sys.exit(f"make native: no C++ compiler {name!r}; install g++ or clang, or set CXX")
    return name


def commands(build: Path, options: tuple[str, ...], sources: str) -> list[list[str]]:
    """Return the command of each object file, named after source and target; ``sources`` is the sources' hash."""
    flags = [*FLAGS, *options]
    start = [compiler(), *flags, "-c", f"-I{SOURCES}"]
    binding = ("-isystem", jax.ffi.include_dir(), f'-DBUILD_HASH="{build_hash(flags, sources)}"')
    result = []
    for source in sorted(SOURCES.glob("*.cc")):
        targets = {} if source.name == "library.cc" else TARGETS
        result.append([*start, *binding, str(source), "-o", str(build / f"{source.stem}.o")])
        for target, (instructions, lanes) in targets.items():
            defines = (f"-DTARGET={target}", f"-DLANES={lanes}")
            output = build / f"{source.stem}.{target}.o"
            result.append([*start, *instructions, *defines, str(source), "-o", str(output)])
    return result


def build_hash(flags: list[str], sources: str) -> str:
    """Return a hash of sources, compiler and flags: compiled programs that are cached name the kernels by it."""
    version = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout
    return hashlib.sha256(repr((version, flags, sources)).encode()).hexdigest()[:12]


def build(options: tuple[str, ...] = ()) -> None:
    """Compile all sources and link them; the library appears under its name when it is complete."""
    stamp = _library["stamp"](SOURCES)
    with tempfile.TemporaryDirectory(dir=LIBRARY.parent) as folder:
        steps = commands(Path(folder), options, stamp["sources"])
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            if any(pool.map(lambda step: subprocess.run(step, check=False).returncode, steps)):
                sys.exit("make native: the compiler failed; its message is above")
        objects = [step[-1] for step in steps]
        library = Path(folder) / LIBRARY.name
        link = [
            compiler(),
            "-shared",
            "-Wl,-s",
            *options,
            *objects,
            "-o",
            str(library),
        ]
        subprocess.run(link, check=True)
        if _library["stamp"](SOURCES) != stamp:
            sys.exit("make native: sources changed during the build; run it again")
        stamp["options"] = " ".join(options)
        library.write_bytes(_library["append_stamp"](library.read_bytes(), stamp))
        # Whatever the umask: drivax loads no library that other users can write.
        library.chmod(library.stat().st_mode & ~0o022)
        library.replace(LIBRARY)
    print(f"wrote {LIBRARY}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--strict", action="store_true", help="warnings are errors")
    parser.add_argument("--sanitize", action="store_true", help="for the tests of memory errors")
    args = parser.parse_args()
    build((*(STRICT if args.strict else ()), *(SANITIZERS if args.sanitize else ())))

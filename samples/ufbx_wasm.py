"""Compiles ufbx (MIT license) to the WebAssembly module that reads FBX: `python samples/ufbx_wasm.py FOLDER OUT`.

FOLDER has ufbx.c and ufbx.h, as `ufbx-c` in the source distribution of the Python package pyufbx has them (0.0.7: ufbx
0.21.2). The compiler is clang with Debian's packages lld, wasi-libc and libclang-rt-dev-wasm32: those of Debian 12 make
the module that is in the repository, to the byte.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TABLES = Path(__file__).with_name("ufbx_tables.c")
FLAGS = (
    "--target=wasm32-wasi",
    "-mexec-model=reactor",
    "-Oz",
    "-flto",
    "-DNDEBUG",
    "-DUFBX_MINIMAL",  # no subdivision, surfaces, caches, evaluated scenes, triangles nor OBJ
    "-DUFBX_NO_STDIO",  # it opens no file: the module imports nothing
    "-DUFBX_NO_SSE",
    "-DUFBX_WASM_32BIT",
    "-Wl,--strip-all",
    "-Wl,--stack-first",  # an overflow of the stack traps in place of overwriting data
    "-Wl,-z,stack-size=1048576",
)


def compile_to(folder: Path, out: Path) -> None:
    """Write the module of the sources in `folder` to `out`."""
    sources = [str(folder / "ufbx.c"), str(TABLES)]
    subprocess.run(["clang", *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(out)], check=True)


if __name__ == "__main__":
    compile_to(*map(Path, sys.argv[1:]))

"""Unpacks meshoptimizer's simplifier (MIT license) from its npm package: `python samples/meshopt_wasm.py FOLDER OUT`.

FOLDER is that of the package, as `npm install meshoptimizer` brings it; OUT takes the WebAssembly module that
`facepipe lod` runs.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path


def unpacked(script: str) -> bytes:
    """The module that the script meshopt_simplifier.js holds: a character is a byte of its table, or two are one."""
    text = re.search(r"var wasm =\s*'([^']+)'", script)
    table = re.search(r"wasmpack = new Uint8Array\(\[([\d,\s]+)\]\)", script)
    if text is None or table is None:
        raise SystemExit("no packed module in the script, expected that of meshoptimizer 1.x")
    common = [int(number) for number in table[1].split(",") if number.strip()]
    digits = iter(_digit(character) for character in text[1])
    return bytes(common[digit] if digit < 60 else (digit - 60) * 64 + next(digits) for digit in digits)


def _digit(character: str) -> int:
    code = ord(character)
    return code - 97 if character >= "a" else code - 39 if character >= "A" else code + 4


if __name__ == "__main__":
    folder, out = map(Path, sys.argv[1:])
    out.write_bytes(unpacked((folder / "meshopt_simplifier.js").read_text(encoding="utf-8")))

"""Programs in WebAssembly end in one line where they take too long, too much memory, or what isn't theirs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from facepipe.core.errors import InputError
from facepipe.core.webassembly import Program, Run

wasmtime = pytest.importorskip("wasmtime")

TEXT = """(module
  (import "host" "hears" (func $hears (param i32) (result i32)))
  (memory (export "memory") 1)
  (func (export "double") (param i32) (result i32) (i32.mul (local.get 0) (i32.const 2)))
  (func (export "endless") (loop (br 0)))
  (func (export "grown") (param i32) (result i32) (memory.grow (local.get 0)))
  (func (export "outside") (result i32) (i32.load (i32.const 65536)))
  (func $deep (export "deep") (call $deep))
  (func (export "asks") (param i32) (result i32) (call $hears (local.get 0)))
  (func (export "divides") (param i32) (result i32) (i32.div_u (i32.const 1) (local.get 0))))"""


def started(folder: Path, *, bounded: bool = True, **limits: Any) -> Run:
    path = folder / "program.wasm"
    path.write_bytes(wasmtime.wat2wasm(TEXT))

    def hears(caller: Any, number: int) -> int:
        if number == 13:
            raise ValueError("no such number")
        return number + 1

    return Run(Program(path, "lod", bounded=bounded), "memory", imports=[hears], **limits)


def test_it_computes_and_calls_what_it_was_given(tmp_path: Path) -> None:
    run = started(tmp_path, most_steps=1000)
    assert (run.call("double", 21), run.call("asks", 1)) == (42, 2)
    assert 0 < run.steps < 100
    run.write(8, b"abc")
    assert run.read(9, 2) == b"bc"
    assert started(tmp_path, bounded=False).call("double", 2) == 4


@pytest.mark.parametrize(
    ("name", "arguments", "reason"),
    [
        ("endless", (), "takes too long"),
        ("deep", (), "call stack exhausted|takes too long"),
        ("outside", (), "out of bounds"),
        ("divides", (0,), "divide by zero"),
        ("asks", (13,), "no such number"),
    ],
)
def test_what_must_not_be_ends_it_in_one_line(
    name: str, arguments: tuple[int, ...], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"program: .*({reason})") as caught:
        started(tmp_path, most_steps=10**6).call(name, *arguments)
    assert len(str(caught.value)) < 150


def test_what_must_not_be_ends_no_process_whose_signals_are_its_own() -> None:
    """As a host has them that puts back its handlers once a program has run."""
    code = f"""
import faulthandler, sys, tempfile
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_webassembly import started
faulthandler.enable()
folder = Path(tempfile.mkdtemp())
started(folder, most_steps=1000).call("double", 1)
faulthandler.disable()
for name, arguments in (("deep", ()), ("outside", ()), ("divides", (0,))):
    try:
        started(folder, most_steps=10**6).call(name, *arguments)
    except Exception as error:
        print(name, type(error).__name__)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout.split()[1::2]) == (0, ["InputError"] * 3), run.stderr


def test_memory_has_a_cap(tmp_path: Path) -> None:
    run = started(tmp_path, most_bytes=1 << 20, most_steps=1000)
    assert run.call("grown", 15) == 1
    assert run.call("grown", 1) == -1
    for address, size in ((0, 1), (-1, 1), (1 << 20, 1), (1, 1 << 20)):
        with pytest.raises(InputError, match="more memory than it may have"):
            run.read(address, size)
        with pytest.raises(InputError, match="more memory than it may have"):
            run.write(address, b"\0" * size)
    with pytest.raises(InputError, match="memory"):
        started(tmp_path, most_bytes=1 << 10, most_steps=1000)


def test_without_wasmtime_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wasmtime", None)
    with pytest.raises(InputError, match=r"expected `pip install 'facepipe\[lod\]'`"):
        Program(tmp_path / "program.wasm", "lod", bounded=False)

"""Whether hostile folders are seen to do harm without the checks that stand against them.

usage: python tests/support/hostile_without.py [WORD ...]      kinds whose names have a word (default all)

The line that refuses a folder is found by running it, and taken out (its `if` is never true, its `raise` raises
nothing); then the next, until the folder is seen to do harm: to read, write, run or bring along what it should not, to
be accepted, or to take 20 seconds or 3 GB. Folders that are of no harm without being refused have their checks in
`QUIET`. A row each: the lines, and what was seen. Exit 1 where nothing was.
"""

from __future__ import annotations

import ast
import gc
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

from command_line import exit_code
from full_faces import full_face
from hostile_folders import Hostile, World, harm, make_stock
from hostile_kinds import HOSTILE
from places import REPOSITORY
from small_sources import made

from facepipe.core.errors import FacepipeError

_SECONDS, _BYTES = 20, 3 << 30  # what takes more does harm too
_MOST = 8  # lines that stand against one folder, one behind the other


class Site(NamedTuple):
    """A line that refuses something, or one that is changed."""

    file: str
    line: int
    old: str = ""  # of a line that is changed, its text
    new: str = ""

    @property
    def name(self) -> str:
        """For people."""
        return f"{Path(self.file).relative_to(REPOSITORY).as_posix()}:{self.line}"


class _Out(ast.NodeTransformer):
    """Takes out what refuses at a line."""

    def __init__(self, line: int) -> None:
        self._line = line

    def visit_If(self, node: ast.If) -> ast.AST:
        """An `if` that has it in its own block is never true."""
        if any(self._is(one) for one in node.body):
            node.test = ast.copy_location(ast.Constant(False), node.test)
            return node
        return self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        """One that stands elsewhere raises nothing."""
        return ast.copy_location(ast.Pass(), node) if self._is(node) else node

    def visit_Return(self, node: ast.Return) -> ast.AST:
        """Nor does the giving of an error."""
        return ast.copy_location(ast.Return(None), node) if self._is(node) else node

    def _is(self, node: ast.stmt) -> bool:
        return isinstance(node, ast.Raise | ast.Return) and node.lineno <= self._line <= (node.end_lineno or 0)


def take_out(file: str, sites: Sequence[Site]) -> None:
    """From now on this process has no such lines, wherever their functions were imported to."""
    text = Path(file).read_text(encoding="utf-8")
    for site in sites:
        assert text.count(site.old) == 1 or not site.old, f"{file} has no single `{site.old}`"
        text = text.replace(site.old, site.new) if site.old else text
    tree: Any = ast.parse(text)
    for site in sites:
        tree = tree if site.old else _Out(site.line).visit(tree)
    ast.fix_missing_locations(tree)
    parts = Path(file).relative_to(REPOSITORY).with_suffix("").parts
    importlib.import_module(".".join(part for part in parts if part not in ("exporters", "__init__")))
    fresh = {_key(code): code for code in _codes(compile(tree, file, "exec"))}
    for one in gc.get_objects():
        if isinstance(one, FunctionType) and one.__code__.co_filename == file:
            code = fresh.get(_key(one.__code__))
            if (code is not None and code.co_code != one.__code__.co_code) or (
                code and code.co_consts != one.__code__.co_consts
            ):
                one.__code__ = code


def _key(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _codes(code: CodeType) -> list[CodeType]:
    return [code, *(inner for one in code.co_consts if isinstance(one, CodeType) for inner in _codes(one))]


def tried(hostile: Hostile, stock: Path, out: Sequence[Site]) -> tuple[list[str], list[Site]]:
    """The harm that a folder does without some lines, in a process of its own; and the lines that refused something."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        answer = json.dumps((["ended by itself"], []))
        try:
            answer = _answer(hostile, stock, out)
        except BaseException as error:
            answer = json.dumps(([f"{type(error).__name__}: {error}"[:100]], []))
        finally:
            os.write(writing, answer.encode()[:60000])
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        said = file.read()
    os.waitpid(pid, 0)
    harms, sites = json.loads(said or '[["took too long, or too much memory"], []]')
    return harms, [Site(*one) for one in sites]


def _answer(hostile: Hostile, stock: Path, out: Sequence[Site]) -> str:
    resource.setrlimit(resource.RLIMIT_DATA, (_BYTES, _BYTES))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_SECONDS)
    os.environ |= {"AWS_EC2_METADATA_DISABLED": "true", "AWS_ENDPOINT_URL": "http://127.0.0.1:9"}  # no other machine
    sites: list[Site] = []
    plain = FacepipeError.__init__

    def noted(self: FacepipeError, where: object, what: str) -> None:
        frame = sys._getframe(1)
        if frame.f_code.co_filename.startswith(str(REPOSITORY)) and "/tests/" not in frame.f_code.co_filename:
            sites.append(Site(frame.f_code.co_filename, frame.f_lineno))
        plain(self, where, what)

    FacepipeError.__init__ = noted  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as top:
        world = World(Path(top).resolve())
        world.settle(stock)
        os.chdir(world.sent)
        hostile.make(world)
        for file in dict.fromkeys(site.file for site in out):
            take_out(file, [site for site in out if site.file == file])
        harms = harm(hostile, world, ())
        os.chdir("/")
    return json.dumps(([one.replace(str(world.top), "")[:160] for one in harms], sites))


def chain(hostile: Hostile, stock: Path) -> tuple[list[Site], list[str]]:
    """The lines without which it does harm, and the harm."""
    out = list(QUIET.get(hostile.name, ()))
    harms, sites = tried(hostile, stock, ())
    assert not harms, (hostile.name, harms)
    if out:
        return out, tried(hostile, stock, out)[0]
    while not harms and len(out) < _MOST:
        new = [site for site in sites if site not in out]
        if not new:
            break
        out.append(new[-1])
        harms, sites = tried(hostile, stock, out)
    return out, harms


def _changed(file: str, old: str, new: str) -> Site:
    path = REPOSITORY / file
    text = path.read_text(encoding="utf-8")
    return Site(str(path), text[: text.find(old)].count("\n") + 1, old, new)


_RECORDS = _changed("facepipe/core/policy/paths.py", "return bool(checked(name, self._urls))", "return True")
_WRITABLE = _changed("facepipe/cooking/cooking.py", "and is_writable(nodes[key].path, roots):", ":")
_LOCK = _changed("facepipe/core/locks.py", "os.open(file, _FLAGS | os.O_CREAT if", "os.open(file, 1 | os.O_CREAT if")
_LIBRARY = _changed("facepipe/importers/wavefront.py", "        if not is_file(path):", "        if False:")
_NAMES_OF_LEDGERS = _changed("facepipe/tasks/ledger.py", "is_shared = path.stat().st_nlink > 1", "is_shared = False")
_REASONS = _changed("facepipe/tasks/ledger.py", 'known = {"error"} if', "known = set() if")
_DIGITS = _changed("facepipe/tasks/ledger.py", "if len(text.lstrip", "if False and len(text.lstrip")
QUIET: dict[str, tuple[Site, ...]] = {
    "state folder, ledger: hard link": (_NAMES_OF_LEDGERS,),
    "ledger, error: none": (_REASONS,),
    "ledger, report: no float": (_DIGITS,),
    **{f"ledger, {field}: {escape} URL": (_RECORDS,) for field in ("reads", "writes") for escape in ("http", "S3")},
}
QUIET |= {f"cook, layer with a recipe: {escape}": (_WRITABLE,) for escape in ("absolute", "above", "linked folder")}
QUIET |= {"lock, file: pipe": (_LOCK,), "obj, library: pipe": (_LIBRARY,)}


def main() -> int:
    """Print the table."""
    kinds = [one for one in HOSTILE if not sys.argv[1:] or any(word in one.name for word in sys.argv[1:])]
    with tempfile.TemporaryDirectory() as folder:
        stock = Path(folder, "stock")
        stock.mkdir()
        make_stock(stock, full_face(), (made(1), made(2)))
        for words in (
            ("inspect", "face.usda"),
            ("export", "face.usda", "-o", "x.glb"),
            ("export", "face.usda", "-o", "x.onnx"),
        ):
            exit_code(*words[:1], stock / words[1], *words[2:2], *(["-o", Path(folder, words[3])] if words[3:] else []))
        unseen = 0
        for one in kinds:
            lines, harms = chain(one, stock)
            unseen += not harms
            print(
                f"{one.name:48} {', '.join(site.name for site in lines)}\n    {harms[0] if harms else 'NO HARM SEEN'}",
                flush=True,
            )
    print(f"{len(kinds)} kinds, {unseen} that no line matters to")
    return int(unseen > 0)


if __name__ == "__main__":
    sys.exit(main())

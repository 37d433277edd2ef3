"""How far the house can be held in the head: lines, modules, imports, functions, comments, of a checkout.

    python benchmarks/house.py                      this checkout
    python benchmarks/house.py --of ../older        another one, beside it
    python benchmarks/house.py --list beside        what a row counts: each module, import or function
    python benchmarks/house.py --comments 7         60 comments drawn by that seed, to be read

The core is facepipe/ less its wings; exporters and schemas are rows of their own. `WINGS` says what belongs to a wing,
in the rooms of before the cut (0654c8d6) as in those of after it. Statements are those of Python's syntax tree, so that
joining lines gains nothing. Rows of time have the command that measures them.
"""

from __future__ import annotations

import argparse
import ast
import functools
import io
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
ROOTS = ("facepipe", "exporters", "schemas")

# What a wing holds, the longest prefix first to count; "core" takes back what stays there.
WINGS = {
    "facepipe.photo": "photo",
    "facepipe.photo_options": "photo",
    "facepipe.processors.photo_fit": "photo",
    "facepipe.processors.photo_fit.masks": "core",
    "facepipe.processors.photo_texture": "photo",
    "facepipe.processors.photo_texture.bake": "core",
    "facepipe.processors.photo_texture.hair": "core",
    "facepipe.processors.photo_texture.registered": "core",
    "facepipe.processors.photo_texture.evened": "core",
    "facepipe.processors.photo_texture.observed": "core",
    "facepipe.processors.photo_texture.seen_skin": "core",
    "facepipe.processors.photo_texture.skin_surface": "core",
    "facepipe.processors.video_frames": "photo",
    "facepipe.learn": "photo",
    "facepipe.learn.features.crops": "core",
    "facepipe.learn.features.description": "core",
    "facepipe.learn.features.onnx_file": "core",
    "facepipe.learn.network_fit": "core",
    "facepipe.learn.networks": "core",
    "facepipe.learn.rig": "core",
    "facepipe.learn.sliders": "core",
    "facepipe.learn.fixed_matrix": "core",
    "facepipe.learn.one_thread": "core",
    "facepipe.learn.descent": "core",
    "facepipe.learn.deformation_network": "neural",
    "facepipe.learn.distil": "core",
    "facepipe.learn.encoder_fit": "neural",
    "facepipe.learn.encoder_network": "neural",
    "facepipe.learn.neural_inverse": "neural",
    "facepipe.pictures.photo_pictures": "photo",
    "facepipe.pictures.photo_render": "photo",
    "facepipe.pictures.photo_report": "photo",
    "facepipe.scanning": "scan",
    "facepipe.processors.rebuild": "scan",
    "facepipe.processors.rebuild.author_neutral": "core",
    "facepipe.processors.scan_landmarks": "scan",
    "facepipe.processors.scan_photos": "scan",
    "facepipe.processors.scan_texture": "scan",
    "facepipe.processors.clean_scan": "scan",
    "facepipe.processors.database": "scan",
    "facepipe.processors.database.array_file": "core",
    "facepipe.processors.database.whole_faces": "core",
    "facepipe.pictures.rebuild_pictures": "scan",
    "facepipe.neural": "neural",
    "facepipe.processors.neural_rig": "neural",
    "facepipe.farm": "farm",
    "facepipe.tasks": "farm",
    "facepipe.cli.batch_child": "farm",
    "facepipe.cli.batch_command": "farm",
    "facepipe.server": "server",
}
COMMENTED = (  # the rooms whose long functions say why
    *("facepipe.geometry", "facepipe.rig", "facepipe.stage", "facepipe.verbs", "facepipe.processors"),
    *("facepipe.photo", "facepipe.scanning", "facepipe.neural"),  # whose verbs stood among the others
    *("facepipe_gltf", "facepipe_onnx", "facepipe_blender", "facepipe_web"),
)
LONG, LONGEST = 20, 60  # lines of a function that says why, and of any
TOGETHER = 500  # lines up to which two modules would be one
VERBS = {  # the classes of a verb
    "fit-bones": ("facepipe.processors.fit_bones", "facepipe.verbs.fit_bones"),
    "rebuild": ("facepipe.processors.rebuild", "facepipe.scanning.rebuild"),
}
DRAWN = 60  # comments

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """A file of Python."""

    name: str
    path: Path
    text: str

    @functools.cached_property
    def tree(self) -> ast.Module:
        """Its syntax."""
        return ast.parse(self.text)

    @property
    def lines(self) -> int:
        """As `wc` counts them."""
        return self.text.count("\n")

    @property
    def is_package(self) -> bool:
        """Whether it is an `__init__`."""
        return self.path.name == "__init__.py"

    @property
    def folder(self) -> str:
        """The package that it is in; a package's own name."""
        return self.name if self.is_package else self.name.rpartition(".")[0]

    @property
    def wing(self) -> str:
        """Of `WINGS`, or core; of others their own package."""
        if not self.name.startswith("facepipe.") and self.name != "facepipe":
            return self.name.partition(".")[0]
        fitting = [prefix for prefix in WINGS if self.name == prefix or self.name.startswith(f"{prefix}.")]
        return WINGS[max(fitting, key=len)] if fitting else "core"

    @functools.cached_property
    def functions(self) -> tuple[Function, ...]:
        """All of them, methods and those within others too."""
        return tuple(node for node in ast.walk(self.tree) if isinstance(node, Function))

    @functools.cached_property
    def comments(self) -> Mapping[int, str]:
        """Line -> comment, without those for tools."""
        tokens = tokenize.generate_tokens(io.StringIO(self.text).readline)
        found = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
        tools = ("noqa", "type:", "pragma", "fmt:", "!")
        return {line: text for line, text in found.items() if not text.startswith(tools)}


class House:
    """The modules of a checkout, and what imports what."""

    def __init__(self, folder: Path) -> None:
        """Read them.

        :param folder: the root of a checkout
        """
        self.modules: dict[str, Module] = {}
        for root in ROOTS:
            for path in sorted((folder / root).rglob("*.py")):
                parts = path.relative_to(folder).with_suffix("").parts
                if "node_modules" in parts or "__pycache__" in parts:
                    continue
                parts = parts if root == "facepipe" else parts[1:]
                name = ".".join(part for part in parts if part != "__init__")
                self.modules[name] = Module(name, path, path.read_text(encoding="utf-8"))

    @property
    def wings(self) -> tuple[str, ...]:
        """Those that are there."""
        return tuple(sorted({one.wing for one in self.of_facepipe} - {"core"}))

    @property
    def of_facepipe(self) -> tuple[Module, ...]:
        """The modules of the core and the wings."""
        return tuple(one for name, one in self.modules.items() if name.split(".")[0] == "facepipe")

    def home(self, module: str, name: str, seen: frozenset[str] = frozenset()) -> str | None:
        """The file that `name` of `module` is from: through packages that give what others define."""
        if f"{module}.{name}" in self.modules:
            return f"{module}.{name}"
        if module not in self.modules:
            return None
        if self.modules[module].is_package and module not in seen:
            for node in ast.walk(self.modules[module].tree):
                if isinstance(node, ast.ImportFrom) and node.module:
                    for alias in node.names:
                        if (alias.asname or alias.name) == name:
                            return self.home(node.module, alias.name, seen | {module}) or node.module
        return module

    @functools.cached_property
    def imports(self) -> Mapping[str, set[str]]:
        """Module -> the files that it imports, anywhere in it and for type checkers too; packages' own lists aside."""
        found: dict[str, set[str]] = {name: set() for name in self.modules}
        for name, module in self.modules.items():
            for node in ast.walk(module.tree):
                if isinstance(node, ast.Import):
                    found[name] |= {alias.name for alias in node.names if alias.name in self.modules}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    found[name] |= {self.home(node.module, alias.name) or name for alias in node.names}
            found[name].discard(name)
        return found

    @functools.cached_property
    def importers(self) -> Mapping[str, set[str]]:
        """Module -> the modules that import it, packages that only give it on aside."""
        found: dict[str, set[str]] = defaultdict(set)
        for name, imported in self.imports.items():
            for one in imported:
                if not (self.modules[name].is_package and one.startswith(f"{name}.")):
                    found[one].add(name)
        return found


def written(module: Module, wings: Mapping[str, str]) -> Iterator[str]:
    """The modules of wings whose names stand as text in a module."""
    for node in ast.walk(module.tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and re.fullmatch(r"[\w.]+(:\w+)?", node.value)
        ):
            name = node.value.replace(":", ".")
            while "." in name and name not in wings:
                name = name.rpartition(".")[0]
            if name in wings:
                yield name


def edges(house: House, wanted: Callable[[str, str], bool]) -> list[str]:
    """Imports, and names as text, from a wing (or the core) to a module of another that are `wanted`."""
    wing_of = {one.name: one.wing for one in house.of_facepipe}
    wings = {name: wing for name, wing in wing_of.items() if wing != "core"}
    found = set()
    for module in house.of_facepipe:
        for name in {*house.imports[module.name], *written(module, wings)} & {*wing_of}:
            if wanted(module.wing, wing_of[name]):
                found.add(f"{module.name} -> {name}")
    return sorted(found)


def circles(house: House) -> list[str]:
    """Groups of files each of which imports, through others, all of the group (Tarjan's components)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[str] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for one in sorted(house.imports[name]):
            if house.modules[name].is_package and one.startswith(f"{name}."):
                continue  # a package's list of what it gives
            if one not in order:
                visit(one)
                low[name] = min(low[name], low[one])
            elif one in stack:
                low[name] = min(low[name], order[one])
        if low[name] == order[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(", ".join(sorted(group)))

    sys.setrecursionlimit(10_000)
    for name in house.modules:
        if name not in order:
            visit(name)
    return found


def beside(house: House) -> list[str]:
    """Modules that one other imports, in the same folder, and that would be short with it."""
    found = []
    for name, module in house.modules.items():
        importers = [house.modules[one] for one in house.importers[name]]
        if len(importers) != 1 or module.is_package or importers[0].folder != module.folder:
            continue
        if module.lines + importers[0].lines <= TOGETHER:
            found.append(f"{name} ({module.lines}) -> {importers[0].name} ({importers[0].lines})")
    return found


def used_once(house: House) -> list[str]:
    """Functions and methods that one place of the code calls, and that nothing gives on or imports.

    Names stand for functions: a module's own, and a class's private methods; other methods are not looked at.
    """
    found = []
    exported = {
        (house.home(name, alias) or "", alias)
        for name, module in house.modules.items()
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for name, alias in ((node.module, one.name) for one in node.names)
    }
    for module in house.modules.values():
        uses = Counter(
            node.id if isinstance(node, ast.Name) else node.attr
            for node in ast.walk(module.tree)
            if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Load)
        )
        own = [node for node in module.tree.body if isinstance(node, Function)]
        classes = [node for node in ast.walk(module.tree) if isinstance(node, ast.ClassDef)]
        own += [
            node
            for one in classes
            for node in one.body
            if isinstance(node, Function) and node.name.startswith("_") and not node.name.startswith("__")
        ]
        found += [
            f"{module.name}: {node.name}"
            for node in own
            if uses[node.name] == 1 and (module.name, node.name) not in exported
        ]
    return found


def length(node: Function) -> int:
    """Its lines, from the first decorator on."""
    first = min([node.lineno, *(one.lineno for one in node.decorator_list)])
    return int(node.end_lineno or first) - first + 1


def longest(house: House) -> list[str]:
    """Functions that are longer than any should be."""
    return [
        f"{module.name}: {node.name} ({length(node)})"
        for module in house.modules.values()
        for node in module.functions
        if length(node) > LONGEST
    ]


def long_functions(house: House) -> Iterator[tuple[Module, Function]]:
    """Those of the rooms whose functions say why; functions within others belong to these."""
    for module in house.modules.values():
        if module.name.startswith(tuple(f"{room}." for room in COMMENTED)) or module.name in COMMENTED:
            inner = {id(deep) for node in module.functions for deep in ast.walk(node) if deep is not node}
            yield from ((module, node) for node in module.functions if id(node) not in inner and length(node) >= LONG)


def uncommented(house: House) -> list[str]:
    """Long functions without a comment."""
    return [
        f"{module.name}: {node.name} ({length(node)})"
        for module, node in long_functions(house)
        if not any(node.lineno <= line <= int(node.end_lineno or 0) for line in module.comments)
    ]


def classes(house: House, verb: str) -> list[str]:
    """The classes of a verb's modules."""
    return [
        f"{module.name}: {node.name}"
        for module in house.modules.values()
        if any(module.name == room or module.name.startswith(f"{room}.") for room in VERBS[verb])
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ClassDef)
    ]


def size(modules: list[Module]) -> tuple[str, ...]:
    """Lines, statements and modules."""
    statements = sum(isinstance(node, ast.stmt) for one in modules for node in ast.walk(one.tree))
    return f"{sum(one.lines for one in modules):,}", f"{statements:,}", f"{len(modules):,}"


def seconds_of_help(folder: Path) -> float:
    """Processor time of `facepipe --help`, the least of five."""
    found = []
    for _ in range(5):
        before = os.times()
        words = [sys.executable, "-P", "-m", "facepipe", "--help"]
        subprocess.run(words, env=with_path(folder), stdout=subprocess.DEVNULL, check=True)
        after = os.times()
        found.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return min(found)


_EXPORT = """
import sys
from pathlib import Path
from facepipe.cli import main
folder = Path(sys.argv[1])
if sys.argv[2] == "sample":
    sys.exit(main(["sample", str(folder / "a.usda"), "--textures", "64"]))
code = main(["export", str(folder / "a.usda"), "-o", str(folder / "a.glb"), "--force"])
ours = [name for name in sys.modules if name.partition(".")[0].startswith("facepipe")]
print(len(ours), file=sys.stderr)
sys.exit(code)
"""


def modules_by_export(folder: Path) -> int:
    """The modules of ours that `facepipe export` loads."""
    with tempfile.TemporaryDirectory() as work:
        for step in ("sample", "export"):
            words = [sys.executable, "-P", "-c", _EXPORT, work, step]
            done = subprocess.run(words, env=with_path(folder), capture_output=True, text=True, check=True)
    return int(done.stderr.split()[-1])


def signature_in_editor(folder: Path) -> str:
    """What a type checker takes `facepipe.blend` for."""
    with tempfile.TemporaryDirectory() as work:
        sample = Path(work) / "sample.py"
        sample.write_text("import facepipe\n\nreveal_type(facepipe.blend)\n")
        words = [sys.executable, "-m", "mypy", "--cache-dir", f"{work}/cache", "--config-file", os.devnull, str(sample)]
        done = subprocess.run(words, env=with_path(folder, "MYPYPATH"), capture_output=True, text=True, cwd=work)
    return next(
        (line.partition("Revealed type is ")[2] for line in done.stdout.splitlines() if "Revealed" in line), "?"
    )


def with_path(folder: Path, name: str = "PYTHONPATH") -> dict[str, str]:
    """The environment in which the packages of a checkout are found first."""
    return {**os.environ, name: os.pathsep.join(str(folder / part) for part in ("", "exporters", "schemas"))}


LISTS: dict[str, Callable[[House], list[str]]] = {
    "core-to-wing": lambda house: edges(house, lambda start, end: start == "core" != end),
    "wing-to-wing": lambda house: edges(house, lambda start, end: "core" not in (start, end) and start != end),
    "circles": circles,
    "beside": beside,
    "used-once": used_once,
    "longest": longest,
    "uncommented": uncommented,
    "fit-bones": lambda house: classes(house, "fit-bones"),
    "rebuild": lambda house: classes(house, "rebuild"),
}


def table(house: House, folder: Path) -> list[tuple[str, str]]:
    """All rows: what, and its figure."""
    every, facepipe = list(house.modules.values()), list(house.of_facepipe)
    parts = {wing: [one for one in facepipe if one.wing == wing] for wing in ("core", *house.wings)}
    for name in ("exporters", "schemas"):
        parts[name] = [one for one in every if one.path.relative_to(folder).parts[0] == name]
    rows = [
        (f"{name}: lines, statements, modules", "  ".join(size(found)))
        for name, found in {"facepipe + exporters + schemas": every, **parts}.items()
    ]
    listed = {name: found(house) for name, found in LISTS.items()}
    functions = sum(len(module.functions) for module in every)
    commented = len([*long_functions(house)])
    share = f"{len(listed['uncommented']) / commented:.0%} of {commented:,}"
    return [
        *rows,
        (f"functions longer than {LONGEST} lines", str(len(listed["longest"]))),
        ("imports core -> wing, wing -> wing", f"{len(listed['core-to-wing'])}, {len(listed['wing-to-wing'])}"),
        ("circles of files", str(len(listed["circles"]))),
        (f"one importer, beside it, <= {TOGETHER} lines together", str(len(listed["beside"]))),
        ("functions with one caller and no export", f"{len(listed['used-once']) / functions:.1%} of {functions:,}"),
        (f"functions of {LONG}+ lines without a comment", share),
        ("classes of fit-bones, rebuild", f"{len(listed['fit-bones'])}, {len(listed['rebuild'])}"),
        ("facepipe.blend in an editor", signature_in_editor(folder)[:100]),
        ("--help: processor seconds", f"{seconds_of_help(folder):.2f}"),
        ("modules by export", str(modules_by_export(folder))),
        (".ci/run; .ci/full; README's second command", "the table that .ci/full prints"),
        ("20 mutants in four rooms, passed by the gate", "benchmarks/mutants.py"),
    ]


def main() -> int:
    """Print the table, a list, or comments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", type=Path, default=REPOSITORY, metavar="FOLDER", help="the root of another checkout")
    parser.add_argument("--list", choices=LISTS, help="what is counted")
    parser.add_argument("--comments", type=int, metavar="SEED", help=f"{DRAWN} comments of long functions")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the table")
    arguments = parser.parse_args()
    folder = arguments.of.resolve()
    house = House(folder)
    if arguments.list:
        print(*LISTS[arguments.list](house), sep="\n")
    elif arguments.comments is not None:
        found = [
            f"{module.path.relative_to(folder)}:{line}: {text}"
            for module, node in long_functions(house)
            for line, text in module.comments.items()
            if node.lineno <= line <= int(node.end_lineno or 0)
        ]
        print(*random.Random(arguments.comments).sample(found, min(DRAWN, len(found))), sep="\n")
    else:
        rows = table(house, folder)
        print(*(f"{name.ljust(60)}  {figure}" for name, figure in rows), sep="\n")
        if arguments.json:
            arguments.json.write_text(json.dumps(dict(rows), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What is loaded when: help brings nothing of others, an export no part of the house that it has no use for."""

from __future__ import annotations

import argparse
import graphlib
import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import grimp
import pytest
from command_line import exit_code

import facepipe
import facepipe.stage
from facepipe.cli import command_module, commands_of

OURS = ("facepipe", "facepipe_schemas", "facepipe_gltf", "facepipe_onnx", "facepipe_web", "facepipe_blender")
MOST_FOR_HELP, MOST_FOR_EXPORT = 30, 90

_PROGRAM = """
import json, sys
before = {*sys.modules}
from facepipe.cli import main
try:
    code = main(sys.argv[1:])
except SystemExit as end:
    code = end.code
assert not code, code
print(json.dumps(sorted({*sys.modules} - before)))
"""


def loaded(*words: str) -> list[str]:
    """The modules that a command line loads in a fresh process."""
    done = subprocess.run([sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found: list[str] = json.loads(done.stdout.splitlines()[-1])
    return found


def ours(modules: list[str]) -> list[str]:
    return [name for name in modules if name.partition(".")[0] in OURS]


def lines() -> list[tuple[str, ...]]:
    """Every command, and every action of those that have some."""
    found: list[tuple[str, ...]] = [()]
    for command in commands_of():
        parser = argparse.ArgumentParser()
        module = command_module(command)
        assert module is not None
        module.configure(parser, ["--help"])
        groups = [one.choices for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
        found += [(command,), *((command, action) for group in groups for action in group)]
    return found


@pytest.mark.parametrize("words", lines(), ids=" ".join)
def test_help_loads_nothing_of_others(words: tuple[str, ...]) -> None:
    modules = loaded(*words, "--help")
    foreign = {name.partition(".")[0] for name in modules} - {*OURS} - sys.stdlib_module_names
    assert not foreign
    assert len(ours(modules)) <= MOST_FOR_HELP, ours(modules)


def test_export_loads_what_it_needs(tmp_path: Path) -> None:
    head = tmp_path / "head.usda"
    assert exit_code("sample", head, "--textures", "64") == 0
    modules = loaded("export", str(head), "-o", str(tmp_path / "head.glb"))
    assert {"pxr", "numpy"} <= {*modules}
    assert not {"torch", "onnx", "onnxruntime", "facepipe.learn", "facepipe.heads", "facepipe.cli.view"} & {*modules}
    assert len(ours(modules)) <= MOST_FOR_EXPORT, ours(modules)


def test_no_module_imports_one_that_imports_it() -> None:
    """What a room gives counts as imported by it; what the public API gives doesn't: all stands below its name."""
    graph = grimp.build_graph(*OURS, exclude_type_checking_imports=True, cache_dir=None)
    given = grimp.build_graph(*OURS, cache_dir=None)
    imports = {
        module: graph.find_modules_directly_imported_by(module)
        | (
            given.find_modules_directly_imported_by(module)
            if given.find_children(module) and module != "facepipe"
            else set()
        )
        for module in graph.modules
    }
    assert len(imports) > 400
    graphlib.TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


def packages() -> list[str]:
    roots = [(name, importlib.import_module(name)) for name in OURS]
    return [
        *OURS,
        *(
            walk_package.name
            for name, root in roots
            for walk_package in pkgutil.walk_packages(
                root.__path__, f"{name}.", onerror=lambda _: None
            )  # without torch
            if walk_package.ispkg and not walk_package.name.startswith("facepipe.learn")
        ),
    ]


def test_no_module_is_called_as_a_name_that_its_package_gives() -> None:
    found = 0
    for name in packages():
        package = importlib.import_module(name)
        given = {*getattr(package, "__all__", ())}
        assert not given & {iter_module.name for iter_module in pkgutil.iter_modules(package.__path__)}, name
        found += len(given)
    assert found > 150


def test_a_lazy_package_gives_what_its_modules_have() -> None:
    from facepipe.stage.face import Face, open_face

    assert facepipe.stage.Face is Face
    assert facepipe.open is open_face
    assert {"Face", "open_face", "save_parts"} <= {*dir(facepipe.stage)}
    with pytest.raises(AttributeError, match=r"module 'facepipe\.stage' has no attribute 'Faces'"):
        facepipe.stage.Faces  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'Faces'"):
        exec("from facepipe.stage import Faces")

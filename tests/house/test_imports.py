"""What is loaded when: help brings nothing of others, an export no part of the house that it has no use for."""

from __future__ import annotations

import argparse
import graphlib
import importlib
import json
import pkgutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import grimp
import pytest
from command_line import exit_code
from needs import TORCH_ROOMS

import facepipe
import facepipe.stage
from facepipe.cli import command_module, commands_of

OURS = ("facepipe", "facepipe_schemas", "facepipe_gltf", "facepipe_onnx", "facepipe_web", "facepipe_blender")
MOST_FOR_HELP, MOST_FOR_EXPORT = 33, 64

_PROGRAM = """
import contextlib, io, json, sys
ours, before, found = sys.argv[1].split(), {*sys.modules}, []
for words in json.loads(sys.argv[2]):
    for name in {*sys.modules} - before:
        if name.partition(".")[0] in ours:
            del sys.modules[name]  # each line loads the house anew
    from facepipe.cli import main
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    assert not code, (words, code)
    found.append(sorted({*sys.modules} - before))
print(json.dumps(found))
"""


def loaded(*lines: tuple[str, ...]) -> list[list[str]]:
    """The modules of ours that each command line loads, and those of others that it or one before it does."""
    words = [sys.executable, "-c", _PROGRAM, " ".join(OURS), json.dumps(lines)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found: list[list[str]] = json.loads(done.stdout)
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


@cache
def loaded_for_help() -> dict[tuple[str, ...], list[str]]:
    return dict(zip(lines(), loaded(*((*words, "--help") for words in lines())), strict=True))


@pytest.mark.parametrize("words", lines(), ids=" ".join)
def test_help_loads_nothing_of_others(words: tuple[str, ...]) -> None:
    modules = loaded_for_help()[words]
    foreign = {name.partition(".")[0] for name in modules} - {*OURS} - sys.stdlib_module_names
    assert not foreign
    assert 0 < len(ours(modules)) <= MOST_FOR_HELP, ours(modules)


def test_export_loads_what_it_needs(tmp_path: Path) -> None:
    head = tmp_path / "head.usda"
    assert exit_code("sample", head, "--textures", "64") == 0
    (modules,) = loaded(("export", str(head), "-o", str(tmp_path / "head.glb")))
    assert {"pxr", "numpy"} <= {*modules}
    assert not {"torch", "onnx", "onnxruntime", "facepipe.rig.torch", "facepipe.heads", "facepipe.cli.view"} & {
        *modules
    }
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
            if walk_package.ispkg and not walk_package.name.startswith(TORCH_ROOMS)
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

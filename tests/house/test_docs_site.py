"""The documentation's site: every public name has an entry in the reference, every page a place in the navigation."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import facepipe_gltf
import facepipe_onnx
import pytest
from pages import blocks
from places import REPOSITORY

import facepipe
from facepipe.actions import function_name, summaries
from facepipe.core.errors import InputError

DOCS = REPOSITORY / "docs"
SITE = (REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8")
ROOMS = ("benchmarks", "docs", "exporters", "facepipe", "samples", "schemas", "tests", "training")
PAGES = [path for pattern in ("*.md", "docs/*.md", "*/README.md") for path in sorted(REPOSITORY.glob(pattern))]
PYTHON = sorted(DOCS.glob("python*.md"))
ENTRIES = {entry for page in PYTHON for entry in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)}


@pytest.mark.parametrize("package", [facepipe, facepipe_gltf, facepipe_onnx])
def test_every_public_name_has_an_entry(package: ModuleType) -> None:
    assert {f"{package.__name__}.{name}" for name in package.__all__} <= ENTRIES


def test_every_action_has_a_section_with_its_function() -> None:
    text = (DOCS / "actions.md").read_text(encoding="utf-8")
    assert {*map(function_name, summaries())} == {*re.findall(r"In Python: `facepipe\.(\w+)\(", text)}


@pytest.mark.parametrize("entry", sorted(ENTRIES))
def test_what_has_an_entry_is_there_and_described(entry: str) -> None:
    module, _, name = entry.rpartition(".")
    thing: Any = getattr(importlib.import_module(module), name)
    assert thing.__doc__, "no docstring"


def test_every_picture_is_drawn_by_one_script_and_shown() -> None:
    drawn = re.findall(r"^@of_docs\ndef (\w+)", (DOCS / "pictures.py").read_text(encoding="utf-8"), re.MULTILINE)
    shown = {name for page in PAGES for name in re.findall(r"(\w+)\.png\)", page.read_text(encoding="utf-8"))}
    assert {*drawn} == {path.stem for path in DOCS.glob("*.png")} == shown


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_what_a_page_names_is_there(page: Path) -> None:
    """Files and folders of the repository, and modules and names that its Python imports."""
    text = page.read_text(encoding="utf-8")
    named = re.findall(rf"`((?:{'|'.join(ROOMS)})/[\w./-]+)`", text)
    assert [
        name for name in named if not re.search("scale_shapes|/dist/", name) and not (REPOSITORY / name).exists()
    ] == []
    for line in ast.walk(ast.parse("".join(blocks(text, "python")))):
        if isinstance(line, ast.ImportFrom) and str(line.module).startswith("facepipe"):
            try:
                module = importlib.import_module(str(line.module))
            except InputError:
                if importlib.util.find_spec("torch"):
                    raise
                continue
            assert [name.name for name in line.names if not hasattr(module, name.name)] == []


def test_every_page_is_in_the_navigation_once() -> None:
    listed = re.findall(r"([\w-]+\.md)$", SITE, re.MULTILINE)
    outside = re.findall(r'^    "[\w/]+\.md": "(\w+\.md)",$', (DOCS / "site_hooks.py").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted([*outside, *(page.name for page in DOCS.glob("*.md"))])


def test_continuous_integration_builds_it_strictly() -> None:
    script = Path(REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    assert re.search(r"mkdocs. build .*--strict", script)

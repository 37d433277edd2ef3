"""The manifest and the types of the public API: made of what actions declare, and true of what is run."""

from __future__ import annotations

import ast
import inspect
import re
import runpy
import shutil
from pathlib import Path
from typing import Any

import pytest
from faces import tiny_face
from mypy import api as mypy
from places import REPOSITORY

import facepipe
from facepipe.actions import cookable, cookables, find_action
from facepipe.api import names
from facepipe.registry import manifest
from facepipe.stage import save_parts

STUB = REPOSITORY / "facepipe" / "__init__.pyi"
FUNCTIONS = {node.name: node for node in ast.parse(STUB.read_text()).body if isinstance(node, ast.FunctionDef)}
# a line with a comment is wrong, and the comment is how mypy says so
SAMPLE = """
from pathlib import Path
import facepipe

facepipe.blend(["a.usda", Path("b.usda")], weights={"eyes": [0.8, 0.2]}, out="c.usda")
facepipe.blend(Path("a.usda"), edges="cotangent", out=Path("c.glb"), overwrite=True, flatten=True)
facepipe.sliders("a.usda", values={"blink": 0.5}, limits="limits.json", out="b.usda")
facepipe.sliders("a.usda", values={"blink": 1}, limits={"joints": {}}, out="b.usda")
facepipe.fit_bones("a.usda", targets=["b.usda", Path("c.usda")], mask=("mouth",), out="d.usda", heatmap="e.png")
facepipe.lod("a.usda", triangles=[4000, 1000], out="b.usda")
facepipe.database_add("a.fpdb", ["b.usda"])
facepipe.database_remove("a.fpdb", "anna", out="b.fpdb")
facepipe.inspect("a.usda")

facepipe.blend("a.usda", out="c.usda", wieghts={})  # call-arg
facepipe.blend("a.usda")  # call-arg
facepipe.blend("a.usda", edges="square", out="c.usda")  # arg-type
facepipe.blend(5, out="c.usda")  # arg-type
facepipe.lod("a.usda", triangles=4000, out="b.usda")  # arg-type
facepipe.lod("a.usda", triangles=[0.5], out="b.usda")  # list-item
facepipe.sliders("a.usda", values={"blink": "shut"}, out="b.usda")  # dict-item
facepipe.fit_bones("a.usda", targets="b.usda", heatmap=True, out="d.usda")  # arg-type
facepipe.inspect("a.usda", out="b.usda")  # call-arg
facepipe.fit_bone("a.usda", targets="b.usda", out="c.usda")  # attr-defined
"""
# what needs the classes that functions take and return
WHOLE = """
import facepipe

report = facepipe.inspect("head.usda")
print(type(report).__name__, report.to_dict()["path"])
face: facepipe.Face = facepipe.open("head.usda")
print(facepipe.blend("head.usda", out="c.usda").sources)
print(facepipe.blend("head.usda", out="c.usda").source)  # attr-defined
facepipe.blend("a.usda", weights=[0.8, 0.2], out="c.usda")  # arg-type
"""


def test_they_are_what_the_generator_makes() -> None:
    made = runpy.run_path(str(REPOSITORY / "schemas" / "generate.py"))["made"]()
    assert len(made) == 2
    for file, text in made.items():
        assert file.read_text(encoding="utf-8") == text, f"{file}: `python schemas/generate.py` makes it"


@pytest.mark.parametrize("verb", manifest()["actions"])
def test_the_manifest_is_true_of_the_actions(verb: str) -> None:
    kind = find_action(verb)
    assert kind is not None
    assert (kind.verb, kind.summary) == (verb, manifest()["actions"][verb]["summary"])
    assert (verb in cookables()) == (cookable(verb) is kind)


@pytest.mark.parametrize("name", sorted({*names()} - {*facepipe.__all__}))
def test_a_typed_function_is_the_one_that_is_run(name: str) -> None:
    """Parameters, kinds, defaults and text; mypy compares defaults with types."""
    function, typed = getattr(facepipe, name), FUNCTIONS[name].args
    found = inspect.signature(function).parameters.values()
    alone = [one for one in found if one.kind is one.POSITIONAL_OR_KEYWORD]
    assert [one.arg for one in typed.args] == [one.name for one in alone]
    assert [one.arg for one in typed.kwonlyargs] == [one.name for one in found if one.kind is one.KEYWORD_ONLY]
    given: list[Any] = [*typed.defaults, *(one for one in typed.kw_defaults if one is not None)]
    assert [ast.literal_eval(one) for one in given] == [one.default for one in found if one.default is not one.empty]
    assert ast.get_docstring(FUNCTIONS[name]) == function.__doc__


def test_every_function_is_typed_and_nothing_else_is() -> None:
    assert {*FUNCTIONS} == {*names()} - {*facepipe.__all__}


def test_reports_are_of_the_types_that_are_said(tmp_path: Path) -> None:
    head = tmp_path / "head.usda"
    save_parts(tiny_face(), head)
    reports = {
        "inspect": facepipe.inspect(head),
        "bake": facepipe.bake(head, spread=10, together=0, out=tmp_path / "motion.usda"),
        "render": facepipe.render(head, size=64, out=tmp_path / "head.png"),
        "blend": facepipe.blend([head], out=tmp_path / "blend.usda"),
    }
    for name, report in reports.items():
        said = ast.unparse(FUNCTIONS[name].returns or ast.Constant(None))
        assert said in {kind.__name__ for kind in type(report).__mro__}, name


def check(text: str, folder: Path, *more: str) -> None:
    """Compare what mypy says of a text with its comments."""
    file = folder / "sample.py"
    file.write_text(text)
    said = mypy.run([str(file), "--strict", "--config-file=", f"--cache-dir={folder / 'cache'}", *more])[0]
    found = re.findall(r"^\S*sample\.py:(\d+): error: .*\[([\w-]+)\]$", said, re.MULTILINE)
    expected = re.findall(r"^.*?(?:  # ([\w-]+))?$", text, re.MULTILINE)
    assert {(int(line), code) for line, code in found} == {
        (number, code) for number, code in enumerate(expected, start=1) if code
    }, said


def test_wrong_calls_are_errors_of_types_and_right_ones_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the one file alone, without what it imports of the house."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "facepipe").mkdir()
    shutil.copy(STUB, tmp_path / "facepipe")
    check(SAMPLE, tmp_path, "--no-site-packages")


@pytest.mark.slow
def test_the_whole_house_agrees(tmp_path: Path) -> None:
    check(SAMPLE + WHOLE, tmp_path)

"""CONTRIBUTING.md's new action, made of its files as they stand there in a copy of the house: all else follows."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import fresh_process
import pytest
from faces import tiny_face
from jsonschema import Draft202012Validator
from pages import blocks
from places import REPOSITORY
from pxr import Usd

from facepipe.stage import save_parts

PAGE = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
ACTION, TEST = "facepipe/verbs/scale_shapes.py", "tests/verbs/test_scale_shapes.py"
HOUSE = ("test_action_page.py", "test_action_schemas.py", "test_readme.py")
FILES = ("README.md", "pyproject.toml", "tests/conftest.py", *(f"tests/house/{name}" for name in HOUSE))
FILES += ("schemas/generate.py",)
FILES += tuple(one.relative_to(REPOSITORY).as_posix() for one in (REPOSITORY / "docs").glob("*.*"))
FILES += tuple(one.relative_to(REPOSITORY).as_posix() for one in (REPOSITORY / "tests" / "support").glob("*.py"))


def test_the_checks_are_those_of_continuous_integration() -> None:
    script = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    script += (REPOSITORY / "README.md").read_text(encoding="utf-8").replace(".venv/bin/", "").split(" && ")
    checks = blocks(PAGE, "sh")[1].splitlines()
    assert len(checks) > 5
    assert [line for line in checks if line not in map(str.strip, "\n".join(script).splitlines())] == []


def test_what_it_names_is_there() -> None:
    named = {name for name in re.findall(r"`([\w.]+/[\w./]*)`", PAGE) if "scale_shapes" not in name}
    assert len(named) > 12
    assert [name for name in sorted(named) if not (REPOSITORY / name).exists()] == []


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the house with the files of the page, and all that is made of declarations; the check asks for it."""
    if Usd.GetVersion() < (0, 26, 5):
        pytest.skip("usdGenSchema of older usd-core lacks the base schemas")
    root = tmp_path_factory.mktemp("house")
    shutil.copytree(REPOSITORY / "facepipe", root / "facepipe", ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, root / name)
    added = dict(re.findall(r"^`(\S+\.py)`:\n\n```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE))
    assert added.keys() == {ACTION, TEST}
    for name, text in added.items():
        assert not (REPOSITORY / name).exists()
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    shutil.copytree(REPOSITORY / "schemas" / "facepipe_schemas", root / "schemas" / "facepipe_schemas")
    check = fresh_process.python(root, root, "schemas/generate.py", "--check")
    assert (check.returncode, "out of date: actions.json, __init__.pyi" in check.stdout) == (1, True), check
    python(root, "schemas/generate.py")
    python(root, "docs/action_pages.py")
    return root


def python(root: Path, *words: object) -> str:
    """Stdout of a process in the copy that finds the copy's package, and must end well."""
    done = fresh_process.python(root, root, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.gate
@pytest.mark.slow
def test_its_tests_pass_and_those_of_the_house(house: Path) -> None:
    assert python(house, "-c", "import facepipe; print(facepipe.__file__)").startswith(str(house))
    chosen = ("-k", "scale or page or table")
    said = python(house, "-m", "pytest", "-q", "-rA", TEST, *(f"tests/house/{name}" for name in HOUSE), *chosen)
    passed = {*re.findall(r"^PASSED \S+::(\S+)", said, re.MULTILINE)}
    each = {
        f"{name}[scale-shapes]" for name in ("test_what_a_recipe_holds_is_valid", "test_an_option_is_declared_once")
    }
    assert each | {"test_the_page_is_what_its_script_makes", "test_an_unknown_shape_is_refused"} <= passed
    python(house, "-m", "ruff", "check", ACTION, TEST)
    python(house, "-m", "ruff", "format", "--check", ACTION, TEST)


def test_its_command_recipe_cook_function_and_schema_work(house: Path, tmp_path: Path) -> None:
    """On a small face in the place of the sample, which is soon read; `sample` has tests of its own."""
    made, *lines = (line.removeprefix("facepipe ") for line in blocks(PAGE, "sh")[2].splitlines())
    assert made == "sample -o head.usdc"
    save_parts(tiny_face(), tmp_path / "head.usdc")
    *before, kept = fresh_process.commands(tmp_path, house, *lines)
    save_parts(tiny_face(1), tmp_path / "head.usdc")
    more = (
        "cook soft.usda",
        "--help",
        "scale-shapes --help",
        "scale-shapes head.usdc --shape jawOpen --factor 0.6 -o same.usda --json",
    )
    cook, help, options, same = after = fresh_process.commands(tmp_path, house, *more)
    assert {(end.returncode, end.stderr) for end in (*before, kept, *after)} == {(0, "")}
    assert "1 up to date" in kept.stdout
    assert "soft.usda: scale-shapes: cooked" in cook.stdout
    assert re.search(r"^  scale-shapes +make blendshapes stronger or weaker$", help.stdout, re.MULTILINE)
    assert re.search(r"--shape NAME +blendshape to scale \(default all\)", options.stdout)
    assert json.loads(same.stdout) == {"path": "same.usda", "shapes": ["jawOpen"], "warnings": []}

    program = """if True:
        import json, facepipe
        from facepipe.actions import find_action
        from facepipe.declare import schema_of
        facepipe.scale_shapes("head.usdc", shapes=["jawOpen"], factor=0.6, out="python.usda")
        print(json.dumps(schema_of(find_action("scale-shapes"))))"""
    made = fresh_process.python(tmp_path, house, "-c", program)
    assert (made.returncode, made.stderr) == (0, "")
    schema = Draft202012Validator(json.loads(made.stdout))
    assert schema.is_valid({"face": "head.usdc", "shapes": ["jawOpen"], "factor": 0.6})
    assert not schema.is_valid({"face": "head.usdc", "factor": 5})
    results = {(tmp_path / name).read_bytes() for name in ("soft.usda", "same.usda", "python.usda")}
    assert len(results) == 1

"""Every option, and every field of a file, that holds a path or URL passes a check; a new one can't come unnoticed."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import os
import re
import runpy
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import Capsys, run
from faces import tiny_face
from places import REPOSITORY

from facepipe.actions import cookables, find_action
from facepipe.core import __version__
from facepipe.declare import fields_of
from facepipe.kinds import Action, FileAction
from facepipe.parts import Recipe
from facepipe.stage import save_parts

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights there")
PAGES = runpy.run_path(str(REPOSITORY / "docs/path_pages.py"))
ROWS: list[Any] = list(PAGES["rows"]())
FIELDS: tuple[Any, ...] = PAGES["FIELDS"]


_CHECKING = ("policy.paths", "reading")
LOOKS = {"open", "read_bytes", "read_text", "iterdir", "glob", "rglob", "walk", "stat", "lstat", "exists", "is_file"}
LOOKS |= {"is_dir", "samefile", "readlink", "unlink", "mkdir", "scandir", "listdir", "isfile", "isdir"}
OPENERS = {"open", "np.load", "np.memmap", "np.fromfile", "zipfile.ZipFile", "onnx.load", "trimesh.load"}
OPENERS |= {"Image.open", "Sdf.Layer.FindOrOpen", "Usd.Stage.Open", "torch.load", "torch.export.load"}
_METHODS = LOOKS | {one.rpartition(".")[2] for one in OPENERS}
NO_FILES = {"facepipe.open", "webbrowser.open", "archive.open"}
POLICY = [importlib.import_module(f"facepipe.core.{one}") for one in _CHECKING]
CHECKS = {
    name
    for module in POLICY
    for name, one in vars(module).items()
    if inspect.isfunction(one)
    and one.__module__ == module.__name__
    and re.match(r"check|file|is_(below|writable|url)", name)
} | {"copy_refusal", "named_source"}  # which call them


def test_the_page_is_that_of_the_declarations() -> None:
    assert PAGES["PAGE"].read_text(encoding="utf-8") == PAGES["page"](), "expected `python docs/path_pages.py`"


_MORE = {"import": ("obj",), "sliders": ("--set", "a=1"), "register-scan": ("--composite", "smile")}
_MORE |= {"--identity": ("ict",), "rebuild": ("project.toml",)}


def _line(row: Any, value: str) -> list[str]:
    """A line of its command with a value of the option, and what must be given besides."""
    kind, words = find_action(row.command), row.command.split()
    words += _MORE.get(row.option, _MORE.get(row.command, ())) if row.option != "project" else ()
    needed = {one.name for one in fields_of(kind) if one.needed} if kind else set()
    for argument in PAGES["_arguments"](row.command):
        name = next(iter(argument.option_strings), argument.dest)
        if name == row.option:
            words += [name, value] if argument.option_strings else [value]
        elif name == "-o":
            words += ["-o", f"new{'.vrm' if row.option == '--meta' else _suffix(kind)}"] if row.option != "out" else []
        elif not argument.option_strings and argument.dest not in ("out", "other", "project"):
            words += ["gone.usda"] * (2 if argument.dest == "files" else 1)
        elif argument.option_strings and argument.dest in needed:
            words += [name, "gone.usda"]
    return words


def _suffix(kind: type[Action[Any]] | None) -> str:
    """Of a result; of commands that are no actions one that `export` and `import` write."""
    return next(iter(kind.suffixes), "") if kind and issubclass(kind, FileAction) else ".usda" if kind else ".glb"


def _refused(capsys: Capsys, check: str, value: str, said: str, **more: Any) -> list[str]:
    """The lines of the options with a check that don't end with a refusal of `value`.

    What is written by --edit is a result that is there, and what by batch a plan says: other tests have these.
    """
    wrong = []
    for row in ROWS:
        if check in row.checks and (check == "check_input" or not {row.command, row.option} & {"batch", "--edit"}):
            line = _line(row, value)
            code, _, error = run(capsys, *line)
            if (code, error.count("\n")) != (2, 1) or said not in error:
                wrong.append(f"{' '.join(line)}: {code} {error}")
    return wrong


@POSIX
def test_what_is_typed_is_checked_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    assert _refused(capsys, "check_input", "pipe", "pipe: is not a regular file") == []
    assert _refused(capsys, "check_input", "http://host/x", "http://host/x: is a URL, expected a file or folder") == []


@POSIX
def test_what_is_written_goes_through_no_link_out_of_the_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    Path("lib").symlink_to("../other")
    names = ("template", "database", "work", "[neutral]\nscan")
    Path("project.toml").write_text("\n".join(f'{name} = "project.toml"' for name in names))
    assert _refused(capsys, "check_written", "lib/x", "outside the roots") == []
    assert (
        _refused(capsys, "check_written", "s3://bucket/x", "s3://bucket/x: is a URL, expected a file or folder") == []
    )
    assert not any((tmp_path / "other").iterdir())


def test_what_a_project_chooses_lies_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    wrong = []
    for row in ROWS:
        if "file_chosen" in row.checks:
            Path("facepipe.toml").write_text(f"[defaults.'{row.command}']\n{row.option[2:]} = '../x.json'\n")
            line = _line(row, "typed.json")
            _, _, error = run(capsys, *line)
            if f"defaults.{row.command}.{row.option[2:]}: {tmp_path}" not in error or "outside the roots" not in error:
                wrong.append(f"{' '.join(line)}: {error}")
    assert wrong == []
    assert sum("file_chosen" in row.checks for row in ROWS) >= 8


@pytest.mark.parametrize("verb", cookables())
def test_what_a_recipe_names_lies_below_the_roots(verb: str, tmp_path: Path, capsys: Capsys) -> None:
    """Of whatever action: no field of one has a way of its own."""
    (tmp_path / "x.json").write_text("{}")
    (tmp_path / "work").mkdir()
    recipe = Recipe(verb=verb, sources=("../x.json",), digests=("sha256:0",), version=__version__)
    save_parts(replace(tiny_face(), recipe=recipe), tmp_path / "work/face.usda")
    code, _, error = run(capsys, "cook", tmp_path / "work/face.usda")
    assert (code, "recipe -> source 1: " in error, "x.json is outside the roots" in error) == (2, True, True)


def _module(name: str) -> Path:
    """Its file; it is not imported: it may need an extra."""
    room = REPOSITORY if name.startswith("facepipe.") else REPOSITORY / "exporters"
    place = room.joinpath(*name.split("."))
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


def _functions(file: Path) -> Iterator[tuple[str, ast.AST]]:
    """The functions of a module by name, methods as CLASS.NAME, each with those in it."""
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        elif isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.{one.name}", one) for one in node.body if isinstance(one, ast.FunctionDef))


def _calls(function: ast.AST) -> Iterator[str]:
    """What it calls, as it is written: `check_copied`, `.exists`, `np.load`."""
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _METHODS:
            yield ast.unparse(node.func)


@pytest.mark.parametrize("field", FIELDS, ids=lambda one: f"{one.file}, {one.field}")
def test_what_a_file_says_passes_the_check_that_the_page_has(field: Any) -> None:
    module, _, name = field.reader.partition(":")
    functions = dict(_functions(_module(module)))
    assert name in functions
    assert not field.check or field.check in _calls(functions[name])
    assert not field.check or field.check in CHECKS


# the rest of what opens, lists or looks at files, and by what right
OPENED = {
    "it comes with facepipe, or is the machine's": """
        facepipe.registry:manifest facepipe.cli:main facepipe.cli.show:_own_stderr
        facepipe.heads.asset:_read facepipe.heads.asset:asset facepipe.heads.assembly:bone_sliders
        facepipe.heads.assembly:identity_sliders facepipe.heads.surfaces:picture_of facepipe.heads.skin:_picture
        facepipe.heads.skin:wrinkle_table
        facepipe.networks.files:own_mask_network facepipe.rig.conventions:_tables
        facepipe.stage.prims:_layer facepipe_blender.addon:write_own_wheel facepipe_gltf.vrm.bones:_conventions
        facepipe_gltf.vrm.expressions:table facepipe_web.build:sources_digest facepipe_web.build:is_built
        facepipe_web.build:build facepipe_web.build:main facepipe_web.build:_locked facepipe_web.build:page_files
        facepipe_web.viewer:view
        """,
    "it was typed, and is checked by the command line or its reader": """
        facepipe.checks:validate facepipe.cli:_project facepipe.importers.npz:read_arrays
        facepipe.verbs.blend.blend:BlendFaces.check facepipe.scanning.database.info_action:DatabaseInfo.look
        facepipe.neural.train_encoder:Checkpoint._file
        facepipe.scanning.rebuild.fit_neutral_action:FitNeutralAction.check
        facepipe.scanning.rebuild.scan_fit:scan_input facepipe.scanning.photos.photos:read_photos
        facepipe.photo.frames.clip:_most_pixels facepipe.stage.files:check_stage_file
        facepipe_blender.panel:FACEPIPE_OT_export.invoke facepipe_blender.panel:FACEPIPE_OT_export.execute
        facepipe_blender.panel:_deliver
        """,
    "it is made here: in a temporary folder, or as a result whose place was checked": """
        facepipe.cli.action_line:ActionLine.run facepipe.hosting.host_face:face_to_bytes
        facepipe.verbs.array_file:write_arrays
        facepipe.scanning.database.database_report:DatabaseReport.as_text facepipe.verbs.eval:Eval.write
        facepipe.neural.bake_action:Bake.text
        facepipe.scanning.rebuild.rebuild_report:write_report
        facepipe.scanning.photos.structure:_write_photos facepipe.scanning.photos.structure:_match
        facepipe.scanning.photos.structure:_triangulated
        facepipe.scanning.photos.surface:_poisson facepipe.stage.face:Face.deriving
        facepipe.stage.files:at_variants facepipe_blender.addon:build
        facepipe_blender.addon:_write_zip facepipe_blender.export_stage:_remove facepipe_blender.export_stage:_finish
        facepipe_gltf.writer:report_of facepipe_gltf.writer:write_glb
        facepipe_web.viewer:write_assets facepipe_web.viewer:_Handler._file
        """,
    "it lies in the folder of a server, which names all that is in it": """
        facepipe.server.app:services_in facepipe.server.artefacts:Artefacts.put
        facepipe.server.artefacts:Artefacts.open facepipe.server.faces_api:_photo_suffix
        facepipe.server.library:Library.stored facepipe.server.library:Library.open facepipe.server.library:Library.lay
        facepipe.server.program:_thumbnail facepipe.server.program:_person facepipe.server.program:_package
        facepipe.server.program:_onnx facepipe.server.runner:Runner.__init__ facepipe.server.runner:Runner._place
        facepipe.server.serve_command:_token facepipe.server.serve_command:_serve facepipe.server.tenants:export
        facepipe.server.uploads:Uploads.__init__ facepipe.server.uploads:Uploads.place
        facepipe.server.uploads:Uploads.add facepipe.server.uploads:Uploads.lay facepipe.server.uploads:Uploads.sweep
        """,
    "what calls it has asked": """
        facepipe.scanning.rebuild.steps:WorkFolder.__init__ facepipe.scanning.rebuild.steps:WorkFolder.step
        facepipe.scanning.rebuild.steps:WorkFolder._read
        facepipe.scanning.rebuild.rebuild:Rebuild._step facepipe.stage.files:open_stage
        facepipe.stage.textures:TextureFolder.write
        facepipe.stage.textures:texture_home facepipe.stage.composition:check_arrays
        """,
    "nothing is read: whether it is there decides how a name is written, or what is said": """
        facepipe.cooking.cooking:Node.below facepipe.cooking.cooking:Node.lost facepipe.hosting.host_face:recipe_from
        facepipe.hosting.host_face:author_neural_rig facepipe.stage.author:save_parts
        """,
}


def test_nothing_else_opens_lists_or_looks_at_files() -> None:
    """What doesn't go through `facepipe.core` asks a check itself, is in the page, or is listed above."""
    listed = {name for names in OPENED.values() for name in names.split()}
    known = {field.reader for field in FIELDS} | listed
    found = {}
    for file, module in _modules():
        for name, function in _functions(file):
            calls = {*_calls(function)}
            if opened := sorted(one for one in calls if _opens(one)):
                found[f"{module}:{name}"] = opened if not calls & CHECKS else []
    unknown = {name: calls for name, calls in found.items() if calls and name not in known}
    assert unknown == {}, "expected facepipe.core.reading, a check of facepipe.core.policy, or a line in OPENED"
    assert {name for name in listed if not found.get(name)} == set(), "expected no line that is not needed"


def _opens(call: str) -> bool:
    return call in OPENERS or ("." in call and call.rpartition(".")[2] in LOOKS and call not in NO_FILES)


def _modules() -> Iterator[tuple[Path, str]]:
    """Those outside of the core; batches have a policy of their own, by URLs and roots, and tests of it."""
    words = re.compile(rf"\b({'|'.join(_METHODS | {'open'})})\(")
    for root in (REPOSITORY / "facepipe", *(REPOSITORY / "exporters").glob("facepipe_*")):
        for file in sorted(root.rglob("*.py")):
            if not words.search(file.read_text(encoding="utf-8")):
                continue
            name = ".".join(file.relative_to(root.parent).with_suffix("").parts).removesuffix(".__init__")
            if not name.startswith(("facepipe.core", "facepipe.farm", "facepipe.tasks")):
                yield file, name

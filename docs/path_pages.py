"""Writes paths.md, of every option and every field of a file that holds a path or URL: `python docs/path_pages.py`."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from facepipe.actions import find_action, summaries
from facepipe.cli import COMMANDS, command_module
from facepipe.cli.action_line import ActionLine
from facepipe.cli.parser import Parser, holds_paths
from facepipe.cli.project_words import NEVER
from facepipe.declare import Field, fields_of
from facepipe.kinds import StageAction
from facepipe.registry import manifest

PAGE = Path(__file__).resolve().parent / "paths.md"
INTRO = """# Paths and URLs, and the checks they pass

`python docs/path_pages.py` makes this page from the declarations of commands and actions, and from its own list of what
files say. The checks are in `facepipe/core/policy/` and `facepipe/core/reading.py`; what they
protect is in [security](../SECURITY.md).

## Options

What is typed is the caller's own choice: `check_input` refuses pipes and devices, and what lies outside the roots where
reads are confined; of words that can be something else than a path the reader asks `check_regular`. `check_written`
refuses links in the roots that lead out of them. What a project file chooses for an option passes `file_chosen`, and
what a recipe holds passes `named_source` when it is cooked or edited.
"""
FILES = """
## What files say, and what is looked for beside them

"""
_TYPED, _WRITTEN, _PROJECT, _RECIPE = "check_input", "check_written", "file_chosen", "named_source"
_REGULAR = "check_regular"  # by the reader: of words that can be something else than a path
_WORDS = ("x.usda", "x.fpb", "x.json")  # of which one is a path where a word can be
_TEXTS = {  # options whose words are texts, of which some are paths or URLs -> their checks
    ("*", "--replace"): "check_model",
    ("batch", "words"): _REGULAR,
    ("serve", "words"): _WRITTEN,
    ("serve", "--artefacts"): "checked",
    ("batch", "--each"): "checked",
    ("batch", "-o"): "is_writable",
}
_NO_PATHS = {  # options whose help speaks of files, and that hold none
    *("--name", "--names", "--scheme", "--neutral", "--prim", "--skeleton", "--bone", "--license-url", "--cluster"),
    *("--host", "--origin", "--database"),
}
_OPENED = {"checkpoint": _WRITTEN, "state": f"{_TYPED} {_WRITTEN}", "folder": _WRITTEN}
_OPENED |= dict.fromkeys(("local", "cache", "tls_cert", "tls_key"), _TYPED)  # of batch and serve: the caller's
_OPENED |= {"output": _WRITTEN, "out": _WRITTEN, "edit": f"{_TYPED} {_WRITTEN}"}
_OPENED |= dict.fromkeys(("face", "other", "onnx", "basis", "files", "source", "stages"), _TYPED)  # of commands
_OPENED |= dict.fromkeys(("neural", "identity", "meta", "weights", "limits", "wheels"), _TYPED) | {"rename": _REGULAR}
_SPEAKS_OF_FILES = re.compile(
    r"\b(files?|folders?|URLs?|DIR|FILE|GLOB|ADDRESS|OUT|PLAN|path)\b|\.(json|csv|toml|usd|npz)|http"
)


class FileField(NamedTuple):
    """What a file says, or what is looked for beside it."""

    file: str
    field: str
    reader: str  # module:function
    check: str  # the function that it calls before anything is opened, listed or made; empty: nothing is
    rule: str


# Each place where a file says a path or a URL, or where a name is looked for: who reads it, and the check it passes.
_BELOW = "below the roots of the file or its folder, links followed"
_STAGES = "stages are read anywhere; all else " + _BELOW
_READ = "anywhere; within the roots where reads are confined"
_WITHIN = "below the roots, links followed"
_CHOSEN = "below the project's folder or given roots; below its own roots where FACEPIPE_PROJECT names it"
_CONFORMS = "no file: a text for people"
_FOUND = "in the folder; a link in it leads below the roots or stays in it"
_URL = "below a root that the caller gave"
_REACHED = "below the roots, of files and of URLs (`Reach`); else the task is done again"

FIELDS = (
    # stages
    FileField(
        "USD layer", "subLayers, references, payloads", "facepipe.stage.layer_files:open_layer", "check_regular", _READ
    ),
    FileField("USD layer", "clips", "facepipe.stage.layer_files:_check_clips", "check_readable", _READ),
    FileField("USD layer", "asset values: textures", "facepipe.stage.materials:copy_refusal", "check_copied", _BELOW),
    FileField(
        "USD layer",
        "facepipe:neuralRig:file",
        "facepipe.stage.recipes:read_neural_rig_link",
        "copy_refusal",
        _BELOW,
    ),
    FileField("USD layer", "facepipe:photo:image", "facepipe.stage.photos:read_photo", "", _CONFORMS),
    # recipes
    FileField("recipe", "sources, to cook", "facepipe.cooking.cooking:read_node", "named_source", _STAGES),
    FileField("recipe", "sources, to edit or make again", "facepipe.performing:_places", "named_source", _STAGES),
    FileField("recipe", "sources", "facepipe.stage.recipes:named_source", "check_copied", _STAGES),
    FileField("folder of photos", "photos, of a recipe's source", "facepipe.stage.recipes:_photos", "files_in", _FOUND),
    FileField("recipe", "results", "facepipe.cooking.cooking:_writable", "is_writable", _WITHIN),
    # projects
    FileField(
        "facepipe.toml",
        "roots",
        "facepipe.core.project:_read",
        "is_url",
        "folders; they count where FACEPIPE_PROJECT names it",
    ),
    FileField("facepipe.toml", "names, defaults", "facepipe.cli.project_words:_seen", "file_chosen", _CHOSEN),
    FileField(
        "project of a rebuild",
        "template, database, scan, landmarks",
        "facepipe.scanning.rebuild.project:_file",
        "file_named",
        _BELOW,
    ),
    FileField(
        "project of a rebuild", "work", "facepipe.scanning.rebuild.project:read_project", "check_writable", _WITHIN
    ),
    FileField(
        "work folder",
        "results of steps",
        "facepipe.scanning.rebuild.steps:WorkFolder.place",
        "check_writable",
        _WITHIN,
    ),
    FileField(
        "work folder", "corrections", "facepipe.scanning.rebuild.steps:WorkFolder.correction", "check_found", _FOUND
    ),
    FileField(
        "work folder",
        "corrections, all",
        "facepipe.scanning.rebuild.steps:WorkFolder.corrections",
        "check_found",
        _FOUND,
    ),
    # other formats
    FileField(
        "glTF", "buffers uri, images uri", "facepipe_gltf.read.document:Document.file_of", "check_copied", _BELOW
    ),
    FileField(
        "glTF that is written",
        "names of its buffers and images",
        "facepipe_gltf.writer:save",
        "check_written",
        _WITHIN,
    ),
    FileField("FBX", "pictures", "facepipe.importers.fbx.materials:_Textures._file", "check_copied", _BELOW),
    FileField("OBJ, MTL", "mtllib, map_Kd", "facepipe.importers.wavefront:_beside", "check_copied", _BELOW),
    FileField("ONNX", "external_data location", "facepipe_onnx.read:_tensor_problem", "", "refused, whatever it says"),
    FileField("landmarks JSON", "image", "facepipe.photo.fit.photo_landmarks:read_landmarks", "", _CONFORMS),
    # what lies in a folder, or beside a file
    FileField("folder of shapes", "*.obj", "facepipe.importers.obj:_files", "files_in", _FOUND),
    FileField("folder of shapes", "landmarks.json", "facepipe.importers.obj:read", "file_beside", _FOUND),
    FileField("folder of ICT-FaceKit", "FaceXModel", "facepipe.importers.ict:read_model", "check_found", _FOUND),
    FileField("folder of ICT-FaceKit", "*.obj", "facepipe.importers.ict:_read_folder", "file_beside", _FOUND),
    FileField("folder of photos", "photos", "facepipe.scanning.photos.photos:photo_files", "files_in", _FOUND),
    FileField("folder of masks", "masks", "facepipe.scanning.photos.photos:_mask", "file_beside", _FOUND),
    FileField("folder of people", "photos", "facepipe.photo.fit.train_photo_action:_photos", "files_in", _FOUND),
    FileField("photo", "*.landmarks.json", "facepipe.photo.fit.train_photo_action:_photos", "file_beside", _FOUND),
    FileField("scan", "*.landmarks.json", "facepipe.scanning.rebuild.declared:landmark_file", "file_beside", _FOUND),
    FileField(
        "scan of a project", "*.landmarks.json", "facepipe.scanning.rebuild.project:_scan", "file_beside", _FOUND
    ),
    FileField("network", "*.onnx.json", "facepipe.networks.onnx_file:describe", "file_beside", _FOUND),
    FileField("graph", "*.onnx.json", "facepipe_onnx.read:validate", "file_beside", _FOUND),
    FileField("graph that is shown", "*.onnx.json", "facepipe_web.viewer:_entry", "check_found", _FOUND),
    # where results go, with what is written beside them
    FileField("result", "files, and folders of reports", "facepipe.core.atomic:_real", "check_written", _WITHIN),
    FileField("result", "before any work", "facepipe.stage.files:check_output", "check_written", _WITHIN),
    FileField("result", "NAME_textures", "facepipe.stage.textures:TextureFolder.add", "check_written", _WITHIN),
    FileField("result", "locks", "facepipe.core.locks:locked", "check_written", _WITHIN),
    # batches
    FileField("plan", "csv at a URL", "facepipe.farm.plan:_of_csv", "checked", _URL),
    FileField("plan", "csv", "facepipe.farm.plan:_of_csv", "check_copied", _BELOW),
    FileField("plan", "glob at a URL", "facepipe.farm.plan:_of_glob", "checked", _URL),
    FileField("plan", "glob", "facepipe.farm.plan:_matching", "check_copied", _BELOW),
    FileField("plan", "out", "facepipe.farm.plan:read_plan", "check_writable", _WITHIN),
    FileField("plan", "results", "facepipe.tasks.program:_check_places", "is_writable", _WITHIN),
    FileField("state folder", "itself", "facepipe.farm.batch:batch", "check_written", _WITHIN),
    FileField("ledger", "reads, writes", "facepipe.farm.batch:Run._last", "", _REACHED),
    FileField("cache of results", "writes", "facepipe.tasks.contents:Cache.fetch", "is_writable", _WITHIN),
)


class Row(NamedTuple):
    """An option that holds paths."""

    command: str
    option: str
    checks: tuple[str, ...]


def rows() -> Iterator[Row]:
    """Every option that holds paths.

    :raises ValueError: one that nobody has said the check of
    """
    commands = [*COMMANDS, *manifest()["commands"]]
    for command in [*commands, *(verb for verb in summaries() if verb not in commands)]:
        for argument in _arguments(command):
            name = next(iter(argument.option_strings), argument.dest)
            checks = _checks(command, name, argument)
            if checks:
                yield Row(command, name, checks)


def _arguments(command: str) -> list[argparse.Action]:
    """Those of a command and of the action of its name."""
    kind = find_action(command)
    modules = [ActionLine(kind)] if kind else []
    modules += [command_module(command)] if command in (*COMMANDS, *manifest()["commands"]) else []
    found: dict[str, argparse.Action] = {}
    for module in modules:
        parser = Parser(add_help=False, common=False)
        module.configure(parser, ["--help"])
        for argument in parser._actions:
            if argument.nargs != 0 and not argument.choices:
                found.setdefault(argument.dest, argument)
    return list(found.values())


def _checks(command: str, name: str, argument: argparse.Action) -> tuple[str, ...]:
    """The checks that an argument passes; none where it holds no path."""
    kind = find_action(command)
    field = next((one for one in fields_of(kind) if one.name == argument.dest), None) if kind else None
    text = _TEXTS.get((command, name)) or _TEXTS.get(("*", name))
    if text:
        return (text,)
    if not holds_paths(argument) and not (field and field.split and any(field.split(one)[0] for one in _WORDS)):
        said = f"{argument.help} {argument.metavar}"
        if argument.type in (None, str) and _SPEAKS_OF_FILES.search(said) and name not in _NO_PATHS:
            raise ValueError(
                f"{command} {name}: '{said}' speaks of files: does it hold a path? expected it in {__file__}"
            )
        return ()
    checks = _of_role(field) or _OPENED.get(argument.dest, "").split()
    if not checks:
        raise ValueError(f"{command} {name}: holds a path, expected its check in {__file__}")
    if name.startswith("--") and name.removeprefix("--") not in NEVER and (field is None or field.role == "option"):
        checks = [*checks, _PROJECT]
    own = kind is not None and not argument.option_strings and argument.dest not in ("out", "output")
    if kind and issubclass(kind, StageAction) and (field.role == "source" and field.kept if field else own):
        checks = [*checks, _RECIPE]
    return tuple(checks)


def _of_role(field: Field | None) -> list[str]:
    roles = {"source": [_REGULAR if field and field.split else _TYPED], "beside": [_WRITTEN], "option": []}
    return [] if field is None else roles[field.role]


def page() -> str:
    """The page."""
    options = _table(("command", "option", "checks"), [(f"`{a}`", f"`{b}`", ", ".join(c)) for a, b, c in rows()])
    fields = [(one.file, one.field, one.check or "-", one.rule, f"`{one.reader}`") for one in FIELDS]
    return f"{INTRO}\n{options}\n{FILES}{_table(('file', 'what', 'check', 'it may lie', 'where'), fields)}\n"


def _table(head: tuple[str, ...], lines: list[tuple[str, ...]]) -> str:
    rule = tuple("---" for _ in head)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *lines))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
    sys.stdout.write(f"{PAGE}\n")

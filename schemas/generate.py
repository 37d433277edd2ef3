"""Makes all that is generated: `python schemas/generate.py [--check]`.

Of schema.usda generatedSchema.usda and plugInfo.json. Of what actions declare ``actions.json``, by which
`facepipe.actions` finds verbs before any is imported, and ``__init__.pyi``: the functions of `facepipe` for editors and
type checkers, which can't see what `facepipe.api` makes of the same declarations at run time. With --check nothing is
written: the exit code says whether the committed files are up to date.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
import tempfile
import textwrap
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import facepipe
from facepipe.api import function_of
from facepipe.core.loading import Home, homes_of
from facepipe.core.reports import Report
from facepipe.declare import Field, fields_of
from facepipe.kinds import Action, StageAction

_SCHEMAS = Path(__file__).resolve().parent / "facepipe_schemas"
_PACKAGE = Path(__file__).resolve().parents[1] / "facepipe"
_SCHEMA_FILES = ("generatedSchema.usda", "plugInfo.json")
_DECLARED = "\n@action("  # in the text of files that declare actions
_PATH = "str | os.PathLike[str]"


def made() -> dict[Path, str]:
    """File -> its text."""
    kinds = actions()
    return {_PACKAGE / "actions.json": manifest(kinds), _PACKAGE / "__init__.pyi": stub(kinds)}


def actions() -> dict[str, type[Action[Any]]]:
    """Verb -> action, of all files of this checkout that declare some.

    :raises SystemExit: a verb that is declared twice
    """
    found: dict[str, type[Action[Any]]] = {}
    for file in sorted(_PACKAGE.rglob("*.py")):
        if _DECLARED not in file.read_text(encoding="utf-8"):
            continue
        name = ".".join(("facepipe", *file.relative_to(_PACKAGE).with_suffix("").parts))
        module = importlib.import_module(name)
        kinds = [kind for kind in vars(module).values() if isinstance(kind, type) and "verb" in vars(kind)]
        own = [kind for kind in kinds if issubclass(kind, Action) and kind.__module__ == name]
        for kind in own:
            if found.setdefault(kind.verb, kind) is not kind:
                raise SystemExit(f"{file}: declares '{kind.verb}' as {found[kind.verb].__module__} does")
    return dict(sorted(found.items()))


def doors() -> list[Any]:
    """The modules by which the core and other wings reach a wing."""
    return [importlib.import_module(f"facepipe.{file.parent.name}.door") for file in sorted(_PACKAGE.glob("*/door.py"))]


def functions() -> dict[str, str]:
    """Public function of a wing that is no action's -> where it is."""
    return {name: place for door in doors() for name, place in getattr(door, "FUNCTIONS", {}).items()}


def manifest(kinds: Mapping[str, type[Action[Any]]]) -> str:
    """actions.json: what `facepipe.registry.manifest` gives."""
    entries = {
        verb: {
            "class": _address(kind),
            "has_recipe": issubclass(kind, StageAction),
            "remote": kind.remote,
            "report": _address(report_of(kind)),
            "summary": kind.summary,
        }
        for verb, kind in kinds.items()
    }
    packages = {verb.split()[0]: kind.__module__.rpartition(".")[0] for verb, kind in kinds.items() if " " in verb}
    groups = {name: importlib.import_module(package).__doc__ or name for name, package in packages.items()}
    named = {door.NAME: door.__name__ for door in doors()}
    former = {name: places for door in doors() for name, places in getattr(door, "FORMER", {}).items()}
    commands = {name: one for door in doors() for name, one in getattr(door, "COMMANDS", {}).items()}
    of_wings = {"commands": commands, "doors": named, "former": former, "functions": functions()}
    found = {"actions": entries, "groups": groups, **of_wings}
    return json.dumps(found, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def _address(kind: type) -> str:
    """Of a class, as entry points have it."""
    return f"{kind.__module__}:{kind.__qualname__}"


def report_of(kind: type[Action[Any]]) -> type[Report]:
    """The class of its report: what it, or the nearest class that it is made of, gives its base as the parameter."""
    for owner in kind.__mro__:
        for base in vars(owner).get("__orig_bases__", ()):
            for given in typing.get_args(base):
                found = _imported(owner, given.__forward_arg__) if isinstance(given, typing.ForwardRef) else given
                if isinstance(found, type) and issubclass(found, Report):
                    return found
    raise SystemExit(f"{kind.verb}: no report")


def _imported(owner: type, name: str) -> Any:
    """What a name means in the module of a class for type checkers, which may be all that it is imported for."""
    module = sys.modules[owner.__module__]
    imports = [node for node in ast.walk(ast.parse(inspect.getsource(module))) if isinstance(node, ast.ImportFrom)]
    for line in imports:
        for alias in line.names:
            if name == (alias.asname or alias.name):
                return getattr(importlib.import_module(str(line.module)), alias.name)
    return getattr(module, name)


def stub(kinds: Mapping[str, type[Action[Any]]]) -> str:
    """__init__.pyi: what the package gives by name, and a function for each other action."""
    homes = homes_of("facepipe")
    given = ["__version__", *facepipe.__all__]
    others = [kind for kind in kinds.values() if function_of(kind).__name__ not in given]
    named: dict[str, type] = {}
    # what signatures name: reports, and values that JSON holds in a way of their own
    values = ((kind, field) for kind in others for field in fields_of(kind) if field.value is not None)
    imported = [_imported(_owner(kind, field), name) for kind, field in values for name in _names(kind, field)]
    for one in [*map(report_of, others), *imported]:
        if one.__name__ in given or named.setdefault(one.__name__, one) is not one:
            raise SystemExit(f"{_address(one)}: another class of its name is in the public API, expected another name")
    homes |= {name: Home(*place.split(":")) for name, place in functions().items()}
    imports = [f"from {homes[name].module} import {homes[name].name} as {name}" for name in given]
    imports += [f"from {one.__module__} import {name}" for name, one in named.items()]
    head = ["import os", "from collections.abc import Mapping, Sequence", "from typing import Any, Literal", ""]
    listed = ["__all__ = [", *(f'    "{name}",' for name in facepipe.__all__), "]"]
    parts = ["# Made by `python schemas/generate.py` of what actions declare.", _quoted(facepipe.__doc__ or "")]
    return "\n".join([*parts, "", *head, *sorted(imports), "", *listed, "", *map(_function, others)])


def _owner(kind: type, field: Field) -> type:
    """The class that declares a field."""
    return next(one for one in kind.__mro__ if field.name in vars(one).get("__annotations__", {}))


def _names(kind: type, field: Field) -> list[str]:
    """The classes that its annotation has."""
    written = ast.parse(_owner(kind, field).__annotations__[field.name])
    return [node.id for node in ast.walk(written) if isinstance(node, ast.Name)]


def _function(kind: type[Action[Any]]) -> str:
    function, fields = function_of(kind), {field.name: field for field in fields_of(kind)}
    lines, alone = [f"def {function.__name__}("], True
    for one in inspect.signature(function).parameters.values():
        if alone and one.kind is one.KEYWORD_ONLY:
            lines.append("    *,")
            alone = False
        asked = one.default is one.empty
        said = (
            _type(kind, fields[one.name])
            if one.name in fields
            else ("bool" if isinstance(one.default, bool) else f"{_PATH} | None" if one.default is None else _PATH)
        )
        lines.append(f"    {one.name}: {said}{'' if asked else f' = {_literal(one.default)}'},")
    doc = textwrap.indent(_quoted(function.__doc__ or ""), "    ")
    return "\n".join([*lines, f") -> {report_of(kind).__name__}:", doc, ""])


def _type(kind: type[Action[Any]], field: Field) -> str:
    """What the function takes for a field."""
    if field.value is not None:
        parts = [*_names(kind, field), "Mapping[str, Any]", *([_PATH] if field.is_read else [])]
    else:
        parts = [_part(one, field) for one in field.kinds if one is not types.NoneType]
    return " | ".join([*parts, *(["None"] if types.NoneType in field.kinds else [])])


def _part(one: Any, field: Field) -> str:
    arguments = typing.get_args(one)
    if typing.get_origin(one) is tuple:
        item = _part(arguments[0], field)
        return f"{item} | Sequence[{item}]" if item == _PATH else f"Sequence[{item}]"
    if typing.get_origin(one) is Mapping:
        return f"Mapping[str, {_part(arguments[1], field)}]"
    if field.choices:
        return f"Literal[{', '.join(map(_literal, field.choices))}]"
    if one is Path or (field.split is not None and field.split("head.usda")[0]):
        return _PATH
    return str(one.__name__)


def _quoted(text: str) -> str:
    """A docstring."""
    text = text.strip().replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    return f'"""{text}\n"""' if "\n" in text else f'"""{text}"""'


def _literal(value: object) -> str:
    """As the house writes it, with double quotes."""
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)


def main() -> int:
    """Write the files, or compare them."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        # run usdGenSchema on schema.usda and write both files into `out`
        command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", str(_SCHEMAS / "schema.usda"), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(
                f"{_SCHEMAS / 'schema.usda'}: usdGenSchema failed: {done.stderr.strip() or done.stdout.strip()}"
            )
        plug_info = out / "plugInfo.json"
        text = plug_info.read_text()
        # the plugin description without the build system's placeholders: a resource plugin in its own folder
        info: dict[str, object] = json.loads(re.sub(r"^#.*$", "", text, flags=re.MULTILINE))
        for plugin in info["Plugins"]:  # type: ignore[attr-defined]
            plugin.update(Type="resource", Root=".", LibraryPath="", ResourcePath=".")
        plug_info.write_text(json.dumps(info, indent=4, sort_keys=True) + "\n")
        generated = out / "generatedSchema.usda"
        # put the full documentation back: usdGenSchema keeps only first sentences, hosts show what is in this file
        from pxr import Sdf

        source, target = Sdf.Layer.FindOrOpen(str(_SCHEMAS / "schema.usda")), Sdf.Layer.FindOrOpen(str(generated))
        for prim in target.rootPrims:
            written = source.GetPrimAtPath(prim.path)
            prim.documentation = written.documentation
            prim.ClearInfo("customData")
            for attribute in prim.properties:
                # a multiple-apply schema's properties gain the namespace and instance name in front
                own = [one for one in written.properties if attribute.name.split(":")[-1] == one.name.split(":")[-1]]
                attribute.documentation = own[0].documentation
                attribute.ClearInfo("customData")
        target.Save()
        files = {_SCHEMAS / name: Path(folder, name).read_text(encoding="utf-8") for name in _SCHEMA_FILES}
    files |= made()
    stale = [file for file, text in files.items() if not file.exists() or file.read_text(encoding="utf-8") != text]
    if "--check" in sys.argv[1:]:
        names = ", ".join(file.name for file in stale)
        print(f"out of date: {names}; `python schemas/generate.py` makes them" if stale else "all is up to date")
        return bool(stale)
    for file in stale:
        file.write_text(files[file], encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What is found by name: plug-ins through entry points, wings through the manifest (actions.json).

Plug-ins are exporters by file suffix, importers by kind, hosts by name. `Exporter` and `Importer` are what modules must
have that ``facepipe.exporters`` and ``facepipe.importers`` name. A host (``facepipe.hosts``) is a module that brings
faces into another program; its command documents what it calls there.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints

    from facepipe.core.reports import ExportReport, Finding
    from facepipe.parts import FaceParts, HasParts
    from facepipe.rig.neural_rig import NeuralEncoder
    from facepipe.stage.recipes import Imported

_MANIFEST = Path(__file__).with_name("actions.json")
EXPORTERS, IMPORTERS, HOSTS = "facepipe.exporters", "facepipe.importers", "facepipe.hosts"


class Exporter(Protocol):
    """Writes faces as files of one format, and checks such files."""

    @property
    def Options(self) -> Any:  # noqa: N802  (a class: a frozen dataclass whose fields are made by `declare.option`)
        """Options of an export; all have defaults."""

    def export(self, face: HasParts, path: Path, options: Any) -> ExportReport:
        """Write the face.

        :param options: an instance of `Options`
        :raises FacepipeError: a face or an option that the format can't hold; then nothing is written
        """

    def outputs(self, path: Path) -> Sequence[Path]:
        """The files that `export` to `path` writes; an exporter of one file may leave this out."""

    def validate(self, path: Path) -> Sequence[Finding]:
        """What is wrong with a file; nothing where it is good.

        :raises InputError: no such file, or one too damaged to open
        """


class NeuralRigs(Protocol):
    """What the wing of neural rigs does for exports and checks."""

    Options: type[Any]  # of a rig on a face: a frozen dataclass

    def load(self, path: Path) -> Any:
        """The rig in a file, with the `topology` that it was learned on.

        :raises InputError: no neural rig
        """

    def attached(self, face: FaceParts, path: Path, options: Any, where: str) -> Any:
        """The `parts` of the face with the rig of a file, `dropped_mm` and `clips_mm` of it, and `warnings`.

        :raises FacepipeError: a damaged rig, or one that was learned on other meshes, joints or skin
        """

    def encoder(self, path: Path) -> NeuralEncoder:
        """The encoder in the file of a rig.

        :raises InputError: a damaged rig, or one without an encoder
        """


class Photos(Protocol):
    """What the wing of photos does for others."""

    def find_landmarks(self, photo: Path, out: Path) -> None:
        """Write where the landmarks of the face in a photo are, as JSON.

        :raises InputError: no photo, or no or several faces in it
        """


class Databases(Protocol):
    """What the wing of scans does for others."""

    def load(self, path: Path) -> Any:
        """The faces in a file (.fpdb).

        :raises InputError: no database
        """


class Importer(Protocol):
    """Reads one kind of files or folders as faces.

    With ``SUFFIXES``, a tuple like ``(".glb",)``, commands that take a face take such files too; with ``contents``, a
    function like `facepipe_gltf.read.contents`, `inspect` prints what such a file is made of.
    """

    @property
    def Options(self) -> Any:  # noqa: N802  (as an exporter's)
        """Options of reading; all have defaults."""

    def read(self, source: Path, options: Any) -> Imported:
        """The face at `source`, with what of it could not be read as warnings.

        :param options: an instance of `Options`
        :raises FacepipeError: a source or option that can't be used
        """


@functools.cache
def manifest() -> dict[str, Any]:
    """What is known of the wings and the actions before one is imported; `python schemas/generate.py` makes it.

    ``actions``: verb -> the class, that of the report, the summary, whether it has a recipe, and whether
    a server does it for others. ``doors``: name -> module.
    ``commands``: command of a wing -> its module and what it does. ``former``: name that a module had -> where it is.
    ``functions``: public function of a wing -> where it is.
    ``groups``: first word of verbs of two words -> text of --help.
    """
    found: dict[str, Any] = json.loads(_MANIFEST.read_text(encoding="utf-8"))
    return found


def own_action(verb: str) -> Any:
    """The class of one of facepipe's own actions, by which a verb finds that of a wing."""
    module, _, name = manifest()["actions"][verb]["class"].partition(":")
    return getattr(importlib.import_module(module), name)


def neural_rigs() -> NeuralRigs:
    """The door of that wing."""
    door: NeuralRigs = importlib.import_module(manifest()["doors"]["neural rigs"])
    return door


def photos() -> Photos:
    """The door of that wing."""
    door: Photos = importlib.import_module(manifest()["doors"]["photos"])
    return door


def databases() -> Databases:
    """The door of that wing."""
    door: Databases = importlib.import_module(manifest()["doors"]["databases"])
    return door


def suffixes() -> tuple[str, ...]:
    """The suffixes some exporter writes, without dot, sorted."""
    return _names(EXPORTERS)


def exporter(path: str | Path) -> Exporter:
    """The exporter module of a path, by its suffix.

    :raises InputError: no exporter for the suffix, or one that can't be loaded or lacks part of the contract
    """
    suffix = Path(path).suffix.lower().removeprefix(".")
    for entry in entries(EXPORTERS, suffix):
        found: Exporter = loaded(entry, "Options", "export", "validate")
        return found
    known = [f".{one}" for one in suffixes()]
    near = did_you_mean(f".{suffix}", known) or f", expected one of {' '.join(known)}"
    raise InputError(path, f"suffix '.{suffix}'{near}")


def outputs(path: str | Path) -> tuple[Path, ...]:
    """The files that the exporter of a path writes for it: the path alone where the exporter lists none.

    :raises InputError: as `exporter`
    """
    module = exporter(path)
    return tuple(module.outputs(Path(path))) if hasattr(module, "outputs") else (Path(path),)


def importers() -> tuple[str, ...]:
    """The kinds that plug-ins read, sorted; `facepipe.importers.kinds` adds those of the house."""
    return _names(IMPORTERS)


def importer(kind: str, others: Iterable[str] = ()) -> Importer:
    """The importer module of a kind that a plug-in reads.

    :param others: kinds that need none, for the message
    :raises InputError: no such kind, or an importer that can't be loaded or lacks part of the contract
    """
    for entry in entries(IMPORTERS, kind):
        found: Importer = loaded(entry, "Options", "read")
        return found
    known = sorted({*importers(), *others})
    near = did_you_mean(kind, known) or f", expected one of {', '.join(known)}"
    raise InputError(f"import {kind}", f"unknown kind{near}")


def host(name: str) -> Any:
    """The host module that is called `name`.

    :raises InputError: it is not installed
    """
    for entry in entries(HOSTS, name):
        return entry.load()
    raise InputError(f"facepipe {name}", "is not part of this installation, expected facepipe installed anew")


def _names(group: str) -> tuple[str, ...]:
    return tuple(sorted({entry.name for entry in entries(group)}))


def entries(group: str, name: str | None = None) -> EntryPoints:
    """What is installed in a group, or of it by that name."""
    found: EntryPoints = _installed(tuple(sys.path)).select(group=group)
    return found if name is None else found.select(name=name)


@functools.lru_cache(1)
def _installed(path: tuple[str, ...]) -> Any:
    """All that is installed on the path, to be selected from; to look takes 0.01 s, and most commands need none."""
    from importlib.metadata import entry_points

    return entry_points()


def loaded(entry: EntryPoint, *contract: str) -> Any:
    """What an entry point names.

    :raises InputError: it can't be imported, or lacks part of its contract
    """
    where = f"plug-in {entry.name} ({entry.value})"
    try:
        plugin = entry.load()
    except Exception as error:  # importing it runs code of others, which may fail in any way
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(where, f"can't be loaded: {why}") from None
    missing = [name for name in contract if name not in dir(plugin)]  # what is there to be loaded stays so
    if missing:
        raise InputError(where, f"has no {missing[0]}, expected {', '.join(contract)}")
    return plugin

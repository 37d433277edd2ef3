"""Recipes of the stages of a rebuild: what each was made of."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from facepipe import __version__
from facepipe.parts import Recipe
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import source_digest

AnyPath = str | os.PathLike[str]


def stage_recipe(
    verb: str, files: Mapping[str, AnyPath | Sequence[AnyPath]], out: AnyPath, options: Mapping[str, object]
) -> Recipe:
    """The recipe to author on a stage that is saved as `out`.

    Sources are `files`, as seen from the folder of `out`; its options are `options`, and under "files" what each is.

    :raises InputError: a source that can't be read
    """
    folder = Path(out).absolute().parent
    seen = {what: _seen(file, folder) for what, file in files.items()}
    sources = tuple(dict.fromkeys(_flat(seen)))
    return Recipe(
        verb=verb,
        sources=sources,
        digests=tuple(source_digest(folder / one) for one in sources),
        options={"files": seen, **options},
        version=__version__,
    )


def _seen(file: AnyPath | Sequence[AnyPath], folder: Path) -> str | list[str]:
    if isinstance(file, str | os.PathLike):
        return relative_path(os.fspath(file), folder)
    return [relative_path(os.fspath(one), folder) for one in file]


def _flat(seen: Mapping[str, str | list[str]]) -> Iterator[str]:
    for one in seen.values():
        yield from [one] if isinstance(one, str) else one

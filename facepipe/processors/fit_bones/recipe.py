"""The recipe of a bone fit: what it takes to fit again after a change."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from facepipe import __version__
from facepipe.digests import digest
from facepipe.options import to_json
from facepipe.parts import Recipe
from facepipe.processors.fit_bones.fit_bones import FitBones
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.target_files import split_file
from facepipe.stage.files import SUFFIXES, relative_path
from facepipe.stage.recipes import source_digest

VERB = "fit-bones"


def fit_bones_recipe(
    rig: str | os.PathLike[str],
    words: Sequence[str],
    out: str | os.PathLike[str],
    fit: FitBones,
    initial: str | None = None,
) -> Recipe:
    """The recipe to author on a fit of the rig at a path that is saved as `out`.

    Sources are the rig and the targets' files, as seen from the folder of `out`.

    :param words: the targets, as `read_targets` takes them
    :param initial: animation or file that ``fit.initial`` came from
    :raises InputError: a source can't be read
    """
    folder = Path(out).absolute().parent
    split = [split_file(word) for word in words]
    files = [os.fspath(rig), *dict.fromkeys(file for file, _ in split if file is not None)]
    targets = [
        word if file is None else relative_path(file, folder) + (f":{name}" if name else "")
        for word, (file, name) in zip(words, split, strict=True)
    ]
    options = {name: getattr(fit, name) for name in to_json(FitBonesOptions())}
    return Recipe(
        verb=VERB,
        sources=tuple(relative_path(file, folder) for file in files),
        digests=tuple(_digest(Path(file)) for file in files),
        options={
            "targets": targets,
            "options": options,
            "limits": fit.limits.to_json(),
            "regions": {name: float(fit.regions[name]) for name in sorted(fit.regions)},
            "mask": list(fit.mask),
            "initial": initial,
        },
        version=__version__,
    )


def _digest(path: Path) -> str:
    return source_digest(path) if path.suffix.lower() in SUFFIXES else digest([path])

"""The recipe of a rebuilt actor: the project, all that it names, and how well the face lies on its scans."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from facepipe import __version__
from facepipe.parts import Recipe
from facepipe.processors.database import Quality
from facepipe.processors.rebuild.project import Project
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import source_digest

VERB = "rebuild"


def rebuild_recipe(project: Project, out: str | os.PathLike[str], quality: Quality) -> Recipe:
    """The recipe to author on an actor that is saved as `out`; sources as seen from its folder, the template first.

    :raises InputError: a source that can't be read
    """
    folder = Path(out).absolute().parent
    files = [project.template, project.path, project.database]
    for scan in (project.neutral, *project.expressions):
        files += [scan.scan, *([scan.landmarks] if scan.landmarks else [])]
    sources = tuple(dict.fromkeys(relative_path(os.fspath(file), folder) for file in files))
    return Recipe(
        verb=VERB,
        sources=sources,
        digests=tuple(source_digest(folder / one) for one in sources),
        options={
            "project": relative_path(os.fspath(project.path), folder),
            "joint": project.joint,
            "quality": dataclasses.asdict(quality),
        },
        version=__version__,
    )

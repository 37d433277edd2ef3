"""Face stages as databases take them: read when they are wanted, so that one is in memory at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.kinds import found_of
from facepipe.processors.database.face_database import FaceDatabase
from facepipe.processors.database.quality import Quality, quality_from
from facepipe.processors.database.whole_faces import Topology, WholeFace, whole_face
from facepipe.rig import set_face
from facepipe.stage import open_face
from facepipe.stage.recipes import file_recipe, source_digest

REBUILT = "rebuild"  # the verb of recipes that state measures


@dataclass
class StageSource:
    """One face stage, read anew by each call."""

    path: Path
    name: str
    base: StageSource | Topology | None = None  # whose meshes it must have, in which order
    base_name: str = ""
    _topology: Topology | None = None

    def __call__(self) -> WholeFace:
        """:raises FacepipeError: a file that can't be read, or another topology"""
        base = self.base.topology() if isinstance(self.base, StageSource) else self.base
        face = whole_face(set_face(open_face(self.path).parts()).parts, str(self.path), base, self.base_name)
        self._topology = face.topology
        return replace(face, name=self.name, source=self.path.name, digest=source_digest(self.path))

    def topology(self) -> Topology:
        """Its meshes."""
        return self._topology or self().topology

    def quality(self) -> Quality | None:
        """The measures on a rebuilt face; None on a face made otherwise.

        :raises InputError: a rebuilt face without them
        """
        recipe = file_recipe(self.path).recipe
        if recipe is None or recipe.verb != REBUILT:
            return None
        found = found_of(recipe)
        if "quality" not in found:
            what = "is rebuilt and states no quality, expected it in its recipe (or --quality, or --ignore-quality)"
            raise InputError(self.path, what)
        return quality_from(found["quality"], f"{self.path} -> recipe -> quality")


def stage_sources(
    paths: Sequence[Path], names: Sequence[str] = (), database: FaceDatabase | None = None, where: str = "the database"
) -> list[StageSource]:
    """Face stages as sources, on the topology of `database`, or of the first of them.

    :param names: one for each; those of the files by default
    :raises InputError: names that are not one for each, or twice
    """
    own = list(names) or [path.stem for path in paths]
    if len(own) != len(paths):
        raise InputError("names", f"{len(own)} names, expected {len(paths)}, one a face")
    for number, name in enumerate(own):
        if not name.strip() or name in own[:number]:
            raise InputError(paths[number], f"name '{name}' empty or twice, expected another by --names")
    found: list[StageSource] = []
    for path, name in zip(paths, own, strict=True):
        base: StageSource | Topology | None = database.topology if database else found[0] if found else None
        base_name = where if database else str(paths[0])
        found.append(StageSource(path=path, name=name, base=base, base_name=base_name))
    return found

"""Blend faces: the eyes of one, the mouth of another, with all shapes and the rig.

A SOURCE is a face stage, or a head of any tool (.glb .gltf .vrm .fbx .obj .ply .stl .off or USD). The first one's mesh
is that of the result: it takes the shape of each source of another topology first, as by `facepipe conform`, for half a
minute each, with a note of how near it came. For that, a first source without landmarks, regions or shapes gets them,
as by `facepipe transfer`. OUT is an override layer over the first SOURCE and needs that file; hand on what --flatten
writes, or -o head.glb at once. --edit needs a stage.

Weights are given per region, one per SOURCE, and normalised to sum 1. Regions are those of the first SOURCE (`facepipe
regions` lists them); regions without weights take --default, or all sources alike. A file of weights holds what the
flags say, which win: {"regions": {"eyes": [0.8, 0.2]}, "default": [0.5, 0.5], "gains": [1, 1], "locked": {"mouth": 2}},
or flat {"eyes": [0.8, 0.2], "default": [0.5, 0.5]}.

Weights below 0 and above 1 (to -1 and 2, once they sum to 1) exaggerate what faces differ by: --set nose=-0.5,1.5.

The recipe stays on the result. --edit blends again from it with what the line changes: weights, locks, sources, and the
options below. --match finds the weights whose blend comes nearest to a target sculpt of the same topology.

examples:
  facepipe blend hero.fbx anna.usdc -o hero.glb --set eyes=0.2,0.8
  facepipe blend a.usda b.usda -o c.usda --set eyes=0.8,0.2 --set mouth=0.3,0.7 --default 0.5,0.5
  facepipe blend --edit c.usda --set eyes=0.6,0.4 --lock mouth=2 --force
  facepipe blend --edit c.usda --replace 2=other.usda -o d.usda
  facepipe blend --match c.usda a.usda b.usda -o e.usda
  facepipe blend a.usda b.usda -o f.usda --default 0.8,0.2 --motion-of 2
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.reading import file_beside
from facepipe.declare import JsonValue, beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.blend.options import BlendOptions

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.stage import Face
    from facepipe.verbs.blend.quality import BlendReport
    from facepipe.verbs.blend.weights import Weights
else:
    Weights = Any


def _dump(weights: Weights | None) -> object:
    from facepipe.verbs.blend.weights import Weights, weights_to_json

    return weights_to_json(weights or Weights())


def _load(content: object, where: str) -> Weights:
    from facepipe.verbs.blend.weights import weights_from_json

    return weights_from_json(content, where)


@action("blend", "mix faces by region, with shapes and rig", remote=True)
@dataclass(frozen=True, kw_only=True)
class BlendFaces(BlendOptions, StageAction["BlendReport"]):
    """The action."""

    sources: tuple[Path, ...] = source(
        "faces or heads; the first gives the mesh, regions, sliders, UVs, materials", metavar="SOURCE"
    )
    weights: Weights | None = option(None, value=JsonValue(_dump, _load))  # None: all sources alike
    match: Path | None = source(
        "find the weights that come nearest to this face", default=None, flag="--match", metavar="TARGET", kept=False
    )
    heatmap: Path | None = beside("draw the result, coloured by its seam residual", ".png", "draw")
    closeup: Path | None = beside(
        "draw where skin lies deepest in an eyeball, teeth or the other lip", ".png", "draw_contact"
    )

    own_flags = ("weights",)

    @classmethod
    def add_flags(cls, parser: Any) -> None:
        add = parser.add_argument
        add("--weights", type=Path, metavar="JSON", help="weights from a file")
        text = "weights of a region; a flag for each"
        add("--set", action="append", default=[], metavar="REGION=W,W,...", help=text)
        add("--default", metavar="W,W,...", help="weights of all other regions, and of points in none")
        add("--gains", metavar="G,G,...", help="factors on each source's weights, everywhere")
        text = "take a region whole from source N, from 1"
        add("--lock", action="append", default=[], metavar="REGION=N", help=text)
        text = "weights of the region count again"
        add("--unlock", action="append", default=[], metavar="REGION", help=text)

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        from facepipe.verbs.blend.weights import Weights, weights_of

        if values.get("match") is not None:
            for flag in ("weights", "set", "default", "gains", "unlock"):
                if getattr(arguments, flag):
                    what = "given with --match, which finds the weights: expected only one of them"
                    raise InputError(f"--{flag}", what)
        return {**values, "weights": weights_of(arguments, values.get("weights") or Weights())}

    @cached_property
    def _first(self) -> Face:
        from facepipe.verbs.blend.topologies import read_source

        return read_source(self.base)

    def made_base(self) -> Face | tuple[FaceParts, tuple[str, ...]]:
        first = self._first
        return first if first.file is None else (first.parts(), first.warnings)

    @property
    def further_files(self) -> tuple[Path, ...]:
        """Landmarks that lie beside a source, of which its face is found."""
        beside = (file_beside(Path(path), f"{Path(path).stem}.landmarks.json") for path in self.sources)
        return tuple(path for path in beside if path is not None)

    def check(self) -> None:
        super().check()
        for number, path in enumerate(self.sources):
            for other in self.sources[:number]:
                if other == path or (other.exists() and path.exists() and other.samefile(path)):
                    raise InputError(path, "is a source twice, expected different faces")

    def author(self, face: Face, job: Job) -> BlendReport:
        from facepipe.parts import all_regions
        from facepipe.verbs.blend.matching import match
        from facepipe.verbs.blend.result import Blend
        from facepipe.verbs.blend.session import BlendSession
        from facepipe.verbs.blend.topologies import gathered
        from facepipe.verbs.blend.weights import Weights

        weights = self.weights or Weights()
        regions = all_regions(face.meshes)
        if self.match is None and regions:  # the blend checks this too, after the work that comes first there
            weights.shares(list(regions), len(self.sources))
        start = time.perf_counter()
        found = gathered(face, [*self.sources, *([] if self.match is None else [self.match])], job)
        faces, face = found.faces[: len(self.sources)], found.faces[0]
        target = None if self.match is None else found.faces[-1]
        session = BlendSession(faces, self, live=False)
        matched = None if target is None else match(session, target, weights.locked)
        weights = weights if matched is None else matched.weights
        recipe = job.recipe(replace(self, weights=weights))
        with job.watch("blend", len(session.sculpts)) as bar:
            report = Blend(weights=weights, options=session.options)(face, session, recipe=recipe, done=bar.update)
        warnings = tuple(dict.fromkeys((*found.warnings, *(matched.warnings if matched else ()), *report.warnings)))
        seconds = time.perf_counter() - start
        return replace(report, match=matched, conformed=found.conformed, warnings=warnings, seconds=seconds)

    def draw(self, face: Face, report: BlendReport, path: Path) -> None:
        """The picture of the seam residual."""
        from facepipe.core.tokens import SEAM_RESIDUAL
        from facepipe.pictures import HeatMap, PictureOptions, picture, save_png

        heatmap = HeatMap(values=face.primvar(SEAM_RESIDUAL), label="seam residual")
        save_png(picture(face.parts(), None, PictureOptions(heatmap=heatmap)), path)

    def draw_contact(self, face: Face, report: BlendReport, path: Path) -> None:
        """The picture of the worst contact, in its shape; the whole face where there is none."""
        from facepipe.pictures import PictureOptions, picture, save_png
        from facepipe.verbs.blend.quality import posed_contact

        parts = face.parts()
        points, near = posed_contact(parts, report)
        save_png(picture(parts, points, PictureOptions(framing=near)), path)

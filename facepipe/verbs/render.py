"""Draw a face.

examples:
  facepipe render head.usdc -o head.png --view three-quarter --set jawOpen=0.7
  facepipe render head.usdc -o nose.png --slider noseWidth=0.8
  facepipe render head.usdc -o moved.png --set jawOpen=1 --heatmap displacement
  facepipe render head.usdc -o regions.png --regions
  facepipe render lods.usdc -o far.png --lod 2
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.declare import BONE_HELP, named_numbers, option, source
from facepipe.kinds import FileAction, Job, action

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.pictures import HeatMap
    from facepipe.stage import Face

_NUMBERS: dict[str, Any] = {"parse": named_numbers, "kept": False}


@dataclass(frozen=True, kw_only=True)
class Posed:
    """Base of actions that pose a face."""

    weights: Mapping[str, float] = option(dict, "shape weight", flag="--set", metavar="SHAPE=WEIGHT", **_NUMBERS)
    bones: Mapping[str, float] = option(dict, BONE_HELP, flag="--bone", metavar="JOINT:CHANNEL=VALUE", **_NUMBERS)
    sliders: Mapping[str, float] = option(
        dict, "slider value, over those that are set", flag="--slider", metavar="SLIDER=VALUE", **_NUMBERS
    )


@action("render", "draw a face")
@dataclass(frozen=True, kw_only=True)
class Render(Posed, FileAction[Report]):
    """The action."""

    output = "picture to write: .png"
    suffixes = (".png",)

    face: Path = source("face stage")
    pose: str | None = option(
        None, "the person: set (as FACE is set, the default), rest (the template), or an animation's first sample"
    )
    lod: int = option(0, "level of detail of a face that `facepipe lod` made, 0 the finest", 0, 99)
    view: Literal["front", "side", "three-quarter"] = option("front", "where it is seen from")
    size: int = option(800, "width and height", 16, 4096, "pixels")
    heatmap: str | None = option(
        None, "colour by a per-point primvar in mm, or by `displacement` from the neutral", metavar="PRIMVAR"
    )
    regions: bool = option(False, "colour by the face's regions, with a legend")
    landmarks: str | None = option(None, "draw numbered landmarks of a scheme", metavar="SCHEME")

    def check(self) -> None:
        super().check()
        if self.sliders and self.pose is not None:
            raise InputError("--pose", "given with --slider, expected only one of them")

    def write(self, job: Job) -> Report:
        from facepipe.core.names import named
        from facepipe.importers import read_face
        from facepipe.pictures import PictureOptions, RegionColors, picture, save_png
        from facepipe.rig.bone_coefficients import coefficients_of

        with job.watch("render", 2) as bar:
            face = read_face(self.face)
            face = face.at_level(self.lod) if self.lod else face
            parts = face.parts()
            weights = named(self.weights, face.shapes, "--set", "shape")
            coefficients = coefficients_of(self.bones, face.skeleton.joints, face.skeleton.names)
            person: dict[str, Any] = {"pose": self.pose or "set"}
            if self.sliders:
                names = [slider.name for slider in face.sliders]
                person = {"sliders": named(self.sliders, names, "--slider", "slider")}
            points = face.evaluate(weights, coefficients=coefficients, **person)
            bar.update()
            options = PictureOptions(
                size=self.size,
                view=self.view,
                heatmap=self._heatmap(face, points),
                regions=RegionColors.from_parts(parts) if self.regions else None,
                landmarks=self.landmarks,
                weights=face.shape_weights(weights, **person),
            )
            save_png(picture(parts, points, options), job.out)
            bar.update()
        return Report(warnings=face.warnings)

    def _heatmap(self, face: Face, points: FloatArray) -> HeatMap | None:
        import numpy as np

        from facepipe.core import tokens
        from facepipe.pictures import HeatMap

        if self.heatmap is None:
            return None
        if self.heatmap == "displacement":
            moved = np.linalg.norm(points - face.evaluate(), axis=1) * face.mm_per_unit
            return HeatMap(values=moved, label="displacement")
        unit = "" if self.heatmap.startswith(tokens.REGION_PRIMVAR) else "mm"
        return HeatMap(values=face.primvar(self.heatmap), label=self.heatmap, unit=unit)

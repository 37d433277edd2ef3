"""Options of the VRM exporter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import option
from facepipe_gltf.options import Options as GltfOptions


@dataclass(frozen=True, kw_only=True)
class Options:
    """What goes into the file, and under which terms."""

    license_url: str = option(
        "", "the model's licence, which facepipe never chooses; VRM 1.0 has https://vrm.dev/licenses/1.0/"
    )
    authors: str = option("", "the model's authors, separated by commas; the face's attribution where not given")
    meta: Path | None = option(None, "JSON object of VRM's further meta fields: version, commercialUsage ...")
    stub_body: bool = option(False, "add the required human bones that the face lacks, as nodes that move no point")
    bones: str = option("", "human bones whose joints have names of their own: BONE=JOINT, separated by commas")
    pose: str = option(
        "set",
        "the person that becomes the rest: set (slider values, applied bone coefficients), rest (the "
        "template), or an animation of the face",
    )
    shapes: str = option("*", "blendshapes to export: globs, separated by commas")
    morph_normals: bool = option(True, "compute the normals of blendshapes that have none; runtimes compute none")

    @property
    def gltf(self) -> GltfOptions:
        """Those of the glTF writer: what every VRM runtime reads."""
        return GltfOptions(shapes=self.shapes, morph_normals=self.morph_normals)

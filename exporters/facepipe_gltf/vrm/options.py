"""Options of the VRM exporter."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from facepipe_gltf.options import Options as GltfOptions


@dataclass(frozen=True, kw_only=True)
class Options:
    """What goes into the file, and under which terms."""

    license_url: str = field(
        default="",
        metadata={
            "help": "the model's licence, which facepipe never chooses; VRM 1.0 has https://vrm.dev/licenses/1.0/"
        },
    )
    authors: str = field(
        default="",
        metadata={"help": "the model's authors, separated by commas; the face's attribution where not given"},
    )
    meta: Path | None = field(
        default=None, metadata={"help": "JSON object of VRM's further meta fields: version, commercialUsage ..."}
    )
    stub_body: bool = field(
        default=False,
        metadata={"help": "add the required human bones that the face lacks, as nodes that move no point"},
    )
    bones: str = field(
        default="",
        metadata={"help": "human bones whose joints have names of their own: BONE=JOINT, separated by commas"},
    )
    pose: str = field(
        default="set",
        metadata={
            "help": "the person that becomes the rest: set (slider values, applied bone coefficients), rest (the "
            "template), or an animation of the face"
        },
    )
    shapes: str = field(default="*", metadata={"help": "blendshapes to export: globs, separated by commas"})
    morph_normals: bool = field(
        default=True, metadata={"help": "compute the normals of blendshapes that have none; runtimes compute none"}
    )

    @property
    def gltf(self) -> GltfOptions:
        """Those of the glTF writer: what every VRM runtime reads."""
        return GltfOptions(shapes=self.shapes, morph_normals=self.morph_normals)

"""Options of the glTF exporter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import POSE_HELP, option
from facepipe_gltf.engines import ANY, ENGINES, Engine


@dataclass(frozen=True, kw_only=True)
class Options:
    """What goes into the file, and how compactly; None: what the engine asks for."""

    pose: str = option("set", POSE_HELP)
    mode: Literal["skin", "morph", "both"] = option(
        "both", "skin: joints without morph targets; morph: targets without joints, posed at rest; both"
    )
    engine: str | None = option(
        None,
        "what will load the file: sets the options below as it needs them, refuses those that it can't "
        "read, and says which names it changes",
        choices=tuple(ENGINES),
    )
    influences: Literal[4, 8] | None = option(
        None, "largest number of joints that move one vertex (default 4, or as many as --engine reads)"
    )
    shapes: str = option("*", "blendshapes to export: globs, separated by commas")
    morph_normals: bool | None = option(None, "compute the normals of blendshapes that have none")
    animations: bool = option(False, "export poses and animations")
    fps: float | None = option(None, "frames per second to sample clips at; their own keys by default", 1.0, 1000.0)
    lods: bool = option(False, "with the lower levels of detail of a face that `facepipe lod` made (MSFT_lod)")
    quantize: bool = option(False, "store all but positions as 8 and 16 bit integers (KHR_mesh_quantization)")
    dense: bool | None = option(None, "store every value of every morph target, for readers that get sparse ones wrong")
    meshopt: bool = option(
        False, "compress without loss (EXT_meshopt_compression); needs node with its package meshoptimizer"
    )
    drop_deltas: float = option(0.0, "leave out offsets of blendshapes shorter than this", 0.0, 100.0, "mm")

    @property
    def reader(self) -> Engine:
        """The engine that the file is for."""
        return ANY if self.engine is None else ENGINES[self.engine]

    @property
    def most_influences(self) -> int:
        """How many joints may move one vertex."""
        return self.influences or (4 if self.engine is None else self.reader.influences)

    @property
    def is_dense(self) -> bool:
        """Whether no accessor may be sparse."""
        return (self.meshopt or not self.reader.sparse) if self.dense is None else self.dense

    @property
    def with_target_normals(self) -> bool:
        """Whether normals are computed for shapes without."""
        return self.reader.target_normals if self.morph_normals is None else self.morph_normals

"""Options of the glTF exporter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Options:
    """What goes into the file, and how compactly."""

    mode: Literal["skin", "morph", "both"] = field(
        default="both",
        metadata={
            "help": "skin: joints without morph targets; morph: targets without joints, posed at rest; both",
            "choices": ("skin", "morph", "both"),
        },
    )
    influences: Literal[4, 8] = field(
        default=4, metadata={"help": "largest number of joints that move one vertex", "choices": (4, 8)}
    )
    shapes: str = field(default="*", metadata={"help": "blendshapes to export: globs, separated by commas"})
    morph_normals: bool = field(
        default=False,
        metadata={"help": "compute the normals of blendshapes that have none"},
    )
    animations: bool = field(default=False, metadata={"help": "export poses and animations"})
    quantize: bool = field(
        default=False, metadata={"help": "store vertices as 8 and 16 bit integers (KHR_mesh_quantization)"}
    )

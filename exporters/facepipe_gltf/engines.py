"""What each engine's glTF reader takes: one table.

Tested with three.js, Babylon.js, Blender, Godot 3 and assimp, which stands for any engine. What Unity's glTFast and
Unreal's Interchange take is what their documentation lists: KHR_mesh_quantization by both, meshopt by glTFast.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from facepipe.errors import InputError

if TYPE_CHECKING:
    from facepipe_gltf.options import Options

_LISTED = 3


@dataclass(frozen=True, kw_only=True)
class Engine:
    """One reader of glTF."""

    title: str
    influences: Literal[4, 8] = 8  # joints of a vertex that it reads
    sparse: bool = True  # it reads sparse accessors of morph targets
    quantized: bool = True  # it reads KHR_mesh_quantization
    meshopt: bool = False  # it reads EXT_meshopt_compression
    target_normals: bool = False  # it shades by the normals of morph targets, and computes none itself
    changed_names: tuple[tuple[str, str], ...] = ()  # patterns in a node's name, and what they become


ANY = Engine(title="glTF 2.0", meshopt=True)
ENGINES: Mapping[str, Engine] = {
    "blender": Engine(title="Blender"),
    "godot": Engine(
        title="Godot 3",
        influences=4,
        sparse=False,
        quantized=False,
        target_normals=True,
        changed_names=((r'[.:@/"]', ""),),
    ),
    "three": Engine(
        title="three.js",
        influences=4,
        meshopt=True,
        target_normals=True,
        changed_names=((r"\s", "_"), (r"[\[\].:/]", "")),
    ),
    "babylon": Engine(title="Babylon.js", meshopt=True, target_normals=True),
    "unity": Engine(title="Unity (glTFast)", influences=4, meshopt=True, target_normals=True),
    "unreal": Engine(title="Unreal (Interchange)", changed_names=((r"[\s.]", "_"),)),
    "generic": Engine(title="any engine", influences=4, sparse=False, quantized=False),
}


def check_engine(options: Options) -> None:
    """:raises InputError: an option that the engine can't read"""
    engine = options.reader
    if options.most_influences > engine.influences:
        raise _refused("--influences 8", engine, f"reads {engine.influences} joints a vertex")
    if not options.is_dense and not engine.sparse:
        raise _refused("--no-dense", engine, "gets sparse morph targets wrong")
    if options.quantize and not engine.quantized:
        raise _refused("--quantize", engine, "reads no quantised attributes reliably")
    if options.meshopt and not engine.meshopt:
        raise _refused("--meshopt", engine, "reads no EXT_meshopt_compression")


def _refused(flag: str, engine: Engine, why: str) -> InputError:
    return InputError(flag, f"{engine.title} {why}, expected an export without it or another --engine")


def engine_warnings(engine: Engine, nodes: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line about the names of nodes that the engine changes."""
    names = [str(node["name"]) for node in nodes]
    changed = {name: renamed(engine, name) for name in names if renamed(engine, name) != name}
    if not changed:
        return []
    few = ", ".join(f"'{old}' is '{new}' there" for old, new in list(changed.items())[:_LISTED])
    more = ", ..." if len(changed) > _LISTED else ""
    return [f"{engine.title} changes {len(changed)} name{'s' * (len(changed) > 1)}: {few}{more}"]


def renamed(engine: Engine, name: str) -> str:
    """What the engine calls a node of this name."""
    for pattern, instead in engine.changed_names:
        name = re.sub(pattern, instead, name)
    return name

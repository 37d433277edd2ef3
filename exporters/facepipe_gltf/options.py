"""Options of the glTF exporter, and what each engine's reader supports."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from facepipe.core.errors import InputError
from facepipe.declare import POSE_HELP, option

TextureFormat = Literal["jpeg", "webp", "png", "ktx2", "kept"]

_LISTED = 3
_WORDS_IN_GODOT = (  # where its String::camelcase_to_underscore puts one
    r"(?<=[^A-Z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z]{2})|(?<=[^0-9])(?=[0-9])|(?<=[0-9])(?=[^0-9][a-z0-9])"
)


def _in_godot(joint: str) -> str:
    """Words apart, lower case, letters and digits of ASCII alone, numbers without leading zeros (Godot 3.2)."""
    words = re.sub(_WORDS_IN_GODOT, "_", joint).lower()
    kept = re.sub(r"[ _]+", "_", re.sub(r"[^a-z0-9_ ]", "", words))
    return re.sub(r"0+(\d+)", r"\1", kept)


@dataclass(frozen=True, kw_only=True)
class Engine:
    """One reader of glTF."""

    title: str
    influences: Literal[4, 8] = 8  # joints of a vertex that it reads
    sparse: bool = True  # it reads sparse accessors of morph targets
    quantized: bool = True  # it reads KHR_mesh_quantization
    meshopt: bool = False  # it reads EXT_meshopt_compression
    webp: bool = False  # it reads EXT_texture_webp
    ktx2: bool = False  # it reads KHR_texture_basisu
    clearcoat: bool = True  # it reads KHR_materials_clearcoat
    sheen: bool = True  # it reads KHR_materials_sheen
    lods: bool = True  # it shows one level of those that MSFT_lod names, and not all
    target_normals: bool = False  # it shades by the normals of morph targets, and computes none itself
    changed_names: tuple[tuple[str, str], ...] = ()  # patterns in a node's name, and what they become
    joint_name: Callable[[str], str] | None = None  # what a joint is called instead


ANY = Engine(title="glTF 2.0", meshopt=True, webp=True, ktx2=True)
ENGINES: Mapping[str, Engine] = {
    "blender": Engine(title="Blender", webp=True),
    "godot": Engine(
        title="Godot 3",
        influences=4,
        sparse=False,
        quantized=False,
        lods=False,
        clearcoat=False,
        sheen=False,
        target_normals=True,
        changed_names=((r'[.:@/"]', ""),),
        joint_name=_in_godot,
    ),
    "three": Engine(
        title="three.js",
        influences=4,
        meshopt=True,
        webp=True,
        ktx2=True,
        target_normals=True,
        changed_names=((r"\s", "_"), (r"[\[\].:/]", "")),
    ),
    "babylon": Engine(title="Babylon.js", meshopt=True, webp=True, ktx2=True, target_normals=True),
    "unity": Engine(title="Unity (glTFast)", influences=4, meshopt=True, ktx2=True, sheen=False, target_normals=True),
    "unreal": Engine(title="Unreal (Interchange)", changed_names=((r"[\s.]", "_"),)),
    "generic": Engine(title="any engine", influences=4, sparse=False, quantized=False, lods=False),
}


@dataclass(frozen=True, kw_only=True)
class Purpose:
    """What a file is for, whatever reads it."""

    expressions: bool = False  # of shapes those alone whose names say what they are, not those of who it is
    merged: bool = False  # teeth, gums and tongue in one mesh and material, both eyes, all hair
    animations: bool = False
    pictures: Literal["jpeg", "webp"] | None = None  # None: as they are
    size: int = 0  # pixels of a picture's longer side at most, at the finest level
    points: bool = False  # vertices say which points they are of, or what they lie on
    small: bool = False  # quantised and compressed where the engine reads that


PURPOSES: Mapping[str, Purpose] = {
    "game": Purpose(expressions=True, merged=True, pictures="jpeg", size=1024, small=True),
    "web": Purpose(expressions=True, merged=True, pictures="webp", size=1024, small=True),
    "persons": Purpose(expressions=True, points=True, pictures="jpeg", size=1024, small=True),
    "film": Purpose(animations=True),
}


def check_engine(options: Options) -> None:
    """:raises InputError: an option that the engine can't read"""
    engine, more = options.reader, options.most_influences > options.reader.influences
    unread = (
        ("--influences 8", more, f"reads {engine.influences} joints a vertex"),
        ("--no-dense", not (options.is_dense or engine.sparse), "gets sparse morph targets wrong"),
        ("--quantize", options.quantize and not engine.quantized, "reads no quantised attributes reliably"),
        ("--lods", options.lods and not engine.lods, "shows all levels at once"),
        ("--meshopt", options.meshopt and not engine.meshopt, "reads no EXT_meshopt_compression"),
        ("--texture-format", options.texture_format == "webp" and not engine.webp, "reads no EXT_texture_webp"),
        ("--texture-format", options.texture_format == "ktx2" and not engine.ktx2, "reads no KHR_texture_basisu"),
    )
    for flag, asked, why in unread:
        if asked:
            raise InputError(flag, f"{engine.title} {why}, expected an export without it or another --engine")


def engine_warnings(
    engine: Engine, nodes: Sequence[Mapping[str, Any]], skins: Sequence[Mapping[str, Any]]
) -> list[str]:
    """A line for each kind of node name that the engine changes, or of joint name that it can't read."""
    joints = {joint for skin in skins for joint in skin["joints"]}
    names = {str(node["name"]): renamed(engine, str(node["name"]), i in joints) for i, node in enumerate(nodes)}
    nameless = [f"'{nodes[i]['name']}'" for i in sorted(joints) if not names[str(nodes[i]["name"])]]
    changed = [f"'{old}' is '{new}' there" for old, new in names.items() if new != old and f"'{old}'" not in nameless]
    lines = [f"{engine.title} changes {_listed(changed)}"] if changed else []
    if nameless:
        why = "joints need an ASCII letter or digit (--rename gives others)"
        lines.append(f"{engine.title} does not load the file for {_listed(nameless)}: {why}")
    return lines


def _listed(names: Sequence[str]) -> str:
    few = ", ".join(names[:_LISTED])
    return f"{len(names)} name{'s' * (len(names) > 1)}: {few}{', ...' if len(names) > _LISTED else ''}"


def renamed(engine: Engine, name: str, joint: bool = False) -> str:
    """The engine's name for a node, or a joint, of this name."""
    if joint and engine.joint_name is not None:
        return engine.joint_name(name)
    for pattern, instead in engine.changed_names:
        name = re.sub(pattern, instead, name)
    return name


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
    purpose: str | None = option(
        None,
        "what is in the file: game and web have one finished person with expressions, few meshes and materials, small "
        "pictures and numbers as small as --engine reads; persons has a head that devices put persons of `facepipe "
        "person` on; film has everything. Options given beside it hold",
        choices=tuple(PURPOSES),
        flag="--for",
    )
    customisable: bool = option(False, "with --for game or web: also the shapes that change who it is")
    texture_format: TextureFormat | None = option(
        None,
        "pictures of materials (default kept, or as --for asks; JPEG only where they have no alpha; ktx2 needs node "
        "with its package ktx2-encoder)",
    )
    texture_size: int | None = option(
        None, "longest side of a picture (default 1024 with --for game or web, half of it a --lod)", 16, 16384, "pixels"
    )
    influences: Literal[4, 8] | None = option(
        None, "largest number of joints that move one vertex (default 4, or as many as --engine reads)"
    )
    shapes: str = option("*", "blendshapes to export: globs, separated by commas")
    morph_normals: bool | None = option(None, "compute the normals of blendshapes that have none")
    animations: bool = option(False, "export poses and animations")
    fps: float | None = option(None, "frames per second to sample clips at; their own keys by default", 1.0, 1000.0)
    lods: bool = option(False, "with the lower levels of detail of a face that `facepipe lod` made (MSFT_lod)")
    quantize: bool | None = option(None, "store all but positions as 8 and 16 bit integers (KHR_mesh_quantization)")
    dense: bool | None = option(None, "store every value of every morph target, for readers that get sparse ones wrong")
    meshopt: bool | None = option(
        None, "compress without loss (EXT_meshopt_compression); needs node with its package meshoptimizer"
    )
    drop_deltas: float = option(0.0, "leave out offsets of blendshapes shorter than this", 0.0, 100.0, "mm")

    @property
    def reader(self) -> Engine:
        """The engine that the file is for."""
        return ANY if self.engine is None else ENGINES[self.engine]

    def at_level(self, lod: int) -> Options:
        """The options for a level of detail, 0 the finest: pictures of lower ones are smaller."""
        size = 0 if self.purpose is None else PURPOSES[self.purpose].size
        return replace(self, texture_size=max(size >> lod, 16)) if lod and size and not self.texture_size else self

    @property
    def restorable(self) -> bool:
        """Whether the file holds what `facepipe import gltf` restores the face by."""
        return self.purpose is None or not PURPOSES[self.purpose].small

    @property
    def with_points(self) -> bool:
        """Whether vertices say which points they are of."""
        return self.restorable or (self.purpose is not None and PURPOSES[self.purpose].points)

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

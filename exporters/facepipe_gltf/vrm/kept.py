"""What a face keeps of the VRM that it came from, written back: names become indices of the document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.records import Json
from facepipe_gltf.document import Document, Places
from facepipe_gltf.materials import Image
from facepipe_gltf.read.document import Value, quote
from facepipe_gltf.vrm.options import EXTENSION, fault
from facepipe_gltf.vrm_format import COLLIDERS, CONSTRAINT, SPRINGS, STUBS, converted, picture_in, section

_NOTED = 12


def kept_meta(parts: FaceParts) -> Json | None:
    """The terms that the face came with, those that VRM knows; None for a face of no VRM."""
    if EXTENSION not in parts.vrm:
        return None
    meta = section(parts.vrm, EXTENSION, "meta")
    return {key: value for key, value in meta.items() if fault(key, value) is None}


def kept_bones(parts: FaceParts) -> dict[str, int]:
    """Human bone -> number of the joint, as the VRM had them, of those that are still there."""
    number = {joint: i for i, joint in enumerate(parts.skeleton.joints)}
    entries = section(parts.vrm, EXTENSION, "humanoid", "humanBones")
    paths = {bone: section(entries, bone).get("node") for bone in entries}
    return {bone: number[path] for bone, path in paths.items() if isinstance(path, str) and path in number}


def kept_stubs(parts: FaceParts) -> set[str]:
    """Human bones that facepipe added to the VRM that the face came from: they are nodes, and no joints of the face."""
    stubs = parts.vrm.get(STUBS)
    return {bone for bone in stubs if isinstance(bone, str)} if isinstance(stubs, list) else set()


@dataclass
class _Indices:
    """Names of a face as indices of the document; see `facepipe_gltf.vrm_format.Links`."""

    nodes: Mapping[str, int]  # by joint
    meshes: Mapping[str, int]
    targets: Mapping[str, Mapping[str, int]]  # by mesh and name
    of_material: Mapping[str | None, list[int]]
    lost: list[str] = field(default_factory=list)
    count: int = 0

    def joint(self, value: Value) -> int:
        if value.text() not in self.nodes:
            raise value.error(f"no joint {quote(value.text())} in the file")
        return self.nodes[value.text()]

    def mesh(self, value: Value) -> int:
        if value.text() not in self.meshes:
            raise value.error(f"no mesh {quote(value.text())} in the file")
        return self.meshes[value.text()]

    def target(self, mesh: Value, value: Value) -> int:
        own = self.targets.get(mesh.text(), {})
        if value.text() not in own:
            raise value.error(f"no shape {quote(value.text())} of {quote(mesh.text())} in the file")
        return own[value.text()]

    def materials(self, value: Value) -> list[int]:
        if value.text() not in self.of_material:
            raise value.error(f"no material {quote(value.text())} in the file")
        return self.of_material[value.text()]

    def image(self, value: Value) -> str:
        return str(value.data)

    def left_out(self, problem: InputError) -> None:
        self.count += 1
        if self.count <= _NOTED:
            self.lost.append(f"{problem.where}: {problem.what}")


def write_back(vrm: Mapping[str, object], places: Places, document: Json) -> tuple[Json, list[str]]:
    """`VRMC_vrm` of the document, without terms and human bones, and lines on what it can't hold.

    Spring bones and constraints go into the document.
    """
    of_material: dict[str | None, list[int]] = {}
    for number, name in enumerate(places.materials):
        of_material.setdefault(name, []).append(number)
    links = _Indices(
        nodes=places.joints,
        meshes={name: node for node, name in enumerate(places.meshes)},
        targets={
            mesh: {name: index for index, name in enumerate(names)}
            for mesh, names in zip(places.meshes, places.targets, strict=True)
        },
        of_material=of_material,
    )
    own = section(vrm, EXTENSION)
    # human bones are chosen with the options of the export, and the terms by those who have them
    rest = {key: value for key, value in own.items() if key not in ("humanoid", "meta")}
    extension = _converted(EXTENSION, rest, links)
    used = set()
    springs = _converted(SPRINGS, section(vrm, SPRINGS), links)
    if springs.keys() - {"specVersion"}:
        document.setdefault("extensions", {})[SPRINGS] = springs
        used.add(SPRINGS)
        used |= {COLLIDERS for one in springs.get("colliders", []) if COLLIDERS in one.get("extensions", {})}
    for joint, constraint in section(vrm, CONSTRAINT).items():
        made = _converted(CONSTRAINT, constraint, links)
        node = places.joints.get(joint)
        if node is None or not made.get("constraint"):
            links.left_out(InputError(f"{CONSTRAINT} -> {quote(joint)}", "the file has no such joint or constraint"))
            continue
        document["nodes"][node].setdefault("extensions", {})[CONSTRAINT] = made
        used.add(CONSTRAINT)
    if used:
        document["extensionsUsed"] = sorted({*document.get("extensionsUsed", []), *used})
    if links.count > _NOTED:
        links.lost.append(f"{links.count - _NOTED} further parts of what VRM says of the avatar")
    return extension, links.lost


def with_thumbnail(meta: Json, document: Document) -> tuple[Json, Document]:
    """The terms with the picture of the model as an image of the document; without it, and a line, where it is none."""
    uri = meta.get("thumbnailImage")
    if uri is None:
        return meta, document
    rest = {key: value for key, value in meta.items() if key != "thumbnailImage"}
    try:
        mime, picture = picture_in(str(uri), f"{EXTENSION} -> meta.thumbnailImage")
    except InputError as problem:
        return rest, replace(document, dropped=(*document.dropped, f"{problem.where}: {problem.what}"))
    entries = document.json.setdefault("images", [])
    entries.append({"name": "thumbnail", "mimeType": mime})
    images = (*document.images, Image(name="thumbnail", mime=mime, data=picture))
    return {**rest, "thumbnailImage": len(entries) - 1}, replace(document, images=images)


def _converted(name: str, data: Any, links: _Indices) -> Json:
    """An extension with indices; empty, with a line, where it can't be read."""
    if not data:
        return {}
    try:
        return converted(name, Value(data, name), links)
    except InputError as problem:
        links.left_out(problem)
        return {}

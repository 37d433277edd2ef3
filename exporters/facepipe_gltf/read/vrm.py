"""What a VRM says of its avatar, brought to the names of a face: bones, expressions, looks, springs and terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.records import Json
from facepipe_gltf.read.document import Document, Value
from facepipe_gltf.read.meshes import Role
from facepipe_gltf.read.skins import Nodes
from facepipe_gltf.read.vrm0 import Migrated, Tail, migrated, turned_round
from facepipe_gltf.vrm.options import EXTENSION, LICENSE_URL
from facepipe_gltf.vrm_format import CONSTRAINT, SPRINGS, STUBS, converted, data_uri, section

FORMER = "VRM"  # the extension of VRM 0.x
_NOTED = 12  # parts left out that are named one by one


@dataclass
class _Numbers:
    """References as they are, to find the nodes that become joints."""

    count: int  # of nodes, with those that are added
    joints: dict[int, None] = field(default_factory=dict)

    def joint(self, value: Value) -> int:
        number = value.integer()
        if number >= self.count:
            raise value.error(f"{number}, but there are {self.count} nodes")
        self.joints[number] = None
        return number

    def mesh(self, value: Value) -> int:
        return value.integer()

    def target(self, mesh: Value, value: Value) -> int:
        return value.integer()

    def materials(self, value: Value) -> list[int]:
        return [value.integer()]

    def image(self, value: Value) -> int:
        return value.integer()

    def left_out(self, problem: InputError) -> None:
        """What is wrong is named when it is brought to names."""


@dataclass
class _Names:
    """Indices of a document as names of the face."""

    document: Document
    joints: Mapping[int, str]  # by node
    meshes: Mapping[int, Mesh]  # by node, as the face has them
    targets: Mapping[int, Sequence[str]]  # by node
    materials_of: Sequence[Sequence[str]]  # by material of the document
    problems: list[str] = field(default_factory=list)
    count: int = 0

    def joint(self, value: Value) -> str:
        if value.integer() not in self.joints:
            raise value.error(f"{value.integer()} is no node of the scene, expected one")
        return self.joints[value.integer()]

    def mesh(self, value: Value) -> str:
        if value.integer() not in self.meshes:
            raise value.error(f"{value.integer()} is no node of the scene with a mesh, expected one")
        return self.meshes[value.integer()].name

    def target(self, mesh: Value, value: Value) -> str:
        names = self.targets.get(mesh.integer(), ())
        if value.integer() >= len(names):
            raise value.error(f"{value.integer()}, but there are {len(names)} morph targets")
        return names[value.integer()]

    def materials(self, value: Value) -> list[str]:
        if value.integer() >= len(self.materials_of):
            raise value.error(f"{value.integer()}, but there are {len(self.materials_of)} materials")
        return list(self.materials_of[value.integer()])

    def image(self, value: Value) -> str:
        entry = self.document.entry("images", value)
        uri, view = entry.get("uri"), entry.get("bufferView")
        if uri is not None:
            picture = self.document.content(uri)
        else:
            data, start, length = self.document.view(entry.require("bufferView") if view is None else view)
            self.document.budget.spend(length, value.error)
            picture = bytes(data[start : start + length])
        return data_uri(picture, value.trail)

    def left_out(self, problem: InputError) -> None:
        self.count += 1
        if self.count <= _NOTED:
            self.problems.append(f"{problem.where}: {problem.what}: left out")


@dataclass
class Avatar:
    """The VRM extensions of a document, of whichever version, as 1.0 has them: with indices."""

    extensions: dict[str, Value]  # of the document
    constraints: dict[int, Value]  # by node
    tails: Sequence[Tail]  # joints to be, numbered after the document's nodes
    turn: bool  # the model looks along -Z
    joints: list[int]  # nodes that are joints, whether a skin has them or not

    def on(self, document: Document, face: FaceParts, read: Places) -> FaceParts:
        """The face with what the file says of its avatar, looking along +Z, with an attribution of its terms.

        :param read: where the face's joints, meshes and shapes are in the document
        """
        face = _with_tails(face, read, self.tails, len(document.entries("nodes")))
        links = _Names(
            document=document,
            joints={node: face.skeleton.joints[joint] for node, joint in read.joints.items()},
            meshes={node: face.meshes[number] for node, number in read.meshes.items()},
            targets={node: read.targets(face.meshes[number], node) for node, number in read.meshes.items()},
            materials_of=read.materials,
        )
        vrm: Json = {}
        for name, value in self.extensions.items():
            if read.stubs and name == EXTENSION:
                value, vrm[STUBS] = _without_stubs(value, links)
            try:
                vrm[name] = converted(name, value, links)
            except InputError as problem:
                links.left_out(problem)
        of_joints: Json = {}
        for node, value in self.constraints.items():
            try:
                made = converted(CONSTRAINT, value, links)
                if not made["constraint"]:
                    raise value.error("constrains nothing, expected roll, aim or rotation")
                of_joints[links.joint(Value(node, value.trail))] = made
            except InputError as problem:
                links.left_out(problem)
        if of_joints:
            vrm[CONSTRAINT] = of_joints
        for line in links.problems:
            document.warn(*line.split(": ", 1))
        if links.count > _NOTED:
            document.warn(document.root, f"{links.count - _NOTED} further parts of its VRM extensions: left out")
        terms = terms_line(section(vrm, EXTENSION, "meta"))
        face = replace(face, vrm=vrm, attribution=face.attribution or terms)
        return turned_round(face) if self.turn else face


@dataclass(frozen=True)
class Places:
    """Where the parts of a face are in the document."""

    joints: dict[int, int]  # node -> number of the joint
    meshes: dict[int, int]  # node -> number of the mesh
    parts: FaceParts  # as read of the document: shapes of another face are those of the same place
    roles: Mapping[int, Sequence[Role]]  # by node
    materials: Sequence[Sequence[str]]  # what each material is called: several, where variants change it otherwise
    stubs: bool  # facepipe wrote it: human bones that are no joints are those that it added

    def targets(self, mesh: Mesh, node: int) -> list[str]:
        """What the morph targets of a node are called on `mesh`: a shape, or ``<shape>_<inbetween>``."""
        own = self.parts.meshes[self.meshes[node]].blendshapes
        names = {one.name: other.name for one, other in zip(own, mesh.blendshapes, strict=True)}
        roles = self.roles.get(node, ())
        return [f"{names[role.shape]}_{role.inbetween}" if role.inbetween else names[role.shape] for role in roles]


def read_avatar(document: Document, nodes: Nodes) -> Avatar | None:
    """The avatar that a document is; None where it has no extension of VRM, or none that can be read.

    :raises InputError: an extension that is no object
    """
    extensions = document.root.get_or("extensions", {})
    found = {name: extensions.get(name) for name in (EXTENSION, SPRINGS)}
    own = {name: value for name, value in found.items() if value is not None}
    former = extensions.get(FORMER)
    is_former = former is not None and EXTENSION not in own
    values = document.entries("nodes")
    constraints = {node: value for node in nodes.shown if (value := values[node].extension(CONSTRAINT)) is not None}
    tails: Sequence[Tail] = ()
    if former is not None and EXTENSION in own:
        document.warn(former, f"left out: the file is {EXTENSION} too")
    elif former is not None:
        made: Migrated = migrated(document, former, nodes)
        own, tails = made.extensions, made.tails
    if not own and not constraints:
        return None
    numbers = _Numbers(len(values) + len(tails))
    for name, value in own.items():
        _look(name, value, numbers)
    for node, value in constraints.items():
        _look(CONSTRAINT, value, numbers)
        numbers.joints[node] = None
    shown = {*nodes.shown}
    return Avatar(
        extensions=own,
        constraints=constraints,
        tails=tails,
        turn=is_former,
        joints=[node for node in numbers.joints if node in shown],
    )


def _look(name: str, value: Value, numbers: _Numbers) -> None:
    try:
        converted(name, value, numbers)
    except InputError:
        return  # it is named when it is brought to names


def _without_stubs(value: Value, links: _Names) -> tuple[Value, list[str]]:
    """The extension without human bones that are no joints, and these."""
    bones = value.get_or("humanoid", {}).get_or("humanBones", {})
    entries = {bone: bones.get_or(bone, {}).get_or("node", None).data for bone in bones.member_names()}
    stubs = [bone for bone, node in entries.items() if not isinstance(node, int) or node not in links.joints]
    own = {bone: data for bone, data in bones.members().items() if bone not in stubs}
    return Value({**value.members(), "humanoid": {"humanBones": own}}, value.trail), stubs


def terms_line(meta: Mapping[str, Any]) -> str:
    """Who made a model, and under which terms, for formats that know no terms; empty where it doesn't say who."""
    who = meta.get("copyrightInformation") or ", ".join(meta.get("authors", ()))
    if not who:
        return ""
    license_url = meta.get("licenseUrl", LICENSE_URL)
    words = (
        f"use by {meta.get('avatarPermission', 'onlyAuthor')}",
        f"{meta.get('commercialUsage', 'personalNonProfit')}",
        f"modification {meta.get('modification', 'prohibited')}",
        f"credit {meta.get('creditNotation', 'required')}",
    )
    return " ".join(f"{who}; {license_url}: {', '.join(words)}".split())


def _with_tails(face: FaceParts, read: Places, tails: Sequence[Tail], first: int) -> FaceParts:
    """The face with joints at the ends of chains, bound as they rest; `read` gets their numbers."""
    if not tails:
        return face
    skeleton = face.skeleton
    joints, names = list(skeleton.joints), list(skeleton.names)
    binds, rests = [np.asarray(skeleton.bind_transforms)], [np.asarray(skeleton.rest_transforms)]
    taken = {*joints}
    for number, tail in enumerate(tails, first):
        joint = read.joints.get(tail.node)
        if joint is None:
            continue
        path = f"{joints[joint]}/end"
        while path in taken:
            path += "_"
        taken.add(path)
        rest = np.eye(4)
        rest[:3, 3] = tail.offset
        read.joints[number] = len(joints)
        joints.append(path)
        names.append(f"{names[joint]}_end")
        rests.append(rest[None])
        binds.append((skeleton.bind_transforms[joint] @ rest)[None])
    longer = Skeleton(
        name=skeleton.name,
        joints=tuple(joints),
        bind_transforms=np.concatenate(binds),
        rest_transforms=np.concatenate(rests),
        transform=skeleton.transform,
    )
    return replace(face, skeleton=longer.called(names))

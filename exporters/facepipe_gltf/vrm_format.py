"""What VRM 1.0 says of an avatar, as a stage keeps it: its extensions, with names in place of indices.

Joints go by their paths, meshes, morph targets and materials by their names. Reading (index -> name), writing (name ->
index) and checking go through the same table of fields: what is not in it is never taken over.

Source: VRMC_vrm-1.0, VRMC_springBone-1.0, VRMC_springBone_extended_collider-1.0 and VRMC_node_constraint-1.0
(vrm-c/vrm-specification).
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from facepipe.core.errors import InputError
from facepipe.core.images import decoding, open_image
from facepipe.records import Json
from facepipe_gltf.read.document import Value, quote
from facepipe_gltf.vrm.bones import PARENTS
from facepipe_gltf.vrm.options import EXTENSION, fault

SPRINGS, CONSTRAINT = "VRMC_springBone", "VRMC_node_constraint"
COLLIDERS = "VRMC_springBone_extended_collider"
STUBS = "stubs"  # beside the extensions: human bones that facepipe added as nodes, which are no joints of the face
VERSION = "1.0"
_URI, _BASE64 = "data:", ";base64,"
_LARGEST_PICTURE = 1 << 22  # bytes: of 1024 x 1024 pixels, which VRM wants, it has one or two million
PRESETS = (
    *("happy", "angry", "sad", "relaxed", "surprised", "neutral"),
    *("aa", "ih", "ou", "ee", "oh", "blink", "blinkLeft", "blinkRight"),
    *("lookUp", "lookDown", "lookLeft", "lookRight"),
)


def data_uri(picture: bytes, where: str) -> str:
    """A picture as text.

    :raises InputError: no PNG or JPEG, or a larger one than a stage keeps
    """
    if len(picture) > _LARGEST_PICTURE:
        raise InputError(where, f"a picture of {len(picture)} bytes, expected at most {_LARGEST_PICTURE}")
    mime = _mime(picture, where)
    return f"{_URI}{mime}{_BASE64}{base64.b64encode(picture).decode()}"


def picture_in(uri: str, where: str) -> tuple[str, bytes]:
    """The MIME type and bytes of a picture that `data_uri` made text of.

    :raises InputError: no such text
    """
    try:
        picture = base64.b64decode(uri.partition(_BASE64)[2], validate=True)
    except ValueError:
        picture = b""
    if not uri.startswith(_URI) or not picture:
        raise InputError(where, "no picture as a data URI, expected one")
    return _mime(picture, where), picture


def _mime(picture: bytes, where: str) -> str:
    expected = "a PNG or JPEG"
    image = open_image(picture, where, ("PNG", "JPEG"), expected=expected)
    with decoding(where, expected):
        image.load()
    return f"image/{str(image.format).lower()}"


class Links(Protocol):
    """What references become, and what is done about what can't be kept. Each raises `InputError` for a wrong one."""

    def joint(self, value: Value) -> Any:
        """Of a node that is a joint."""

    def mesh(self, value: Value) -> Any:
        """Of a node that shows a mesh."""

    def target(self, mesh: Value, value: Value) -> Any:
        """Of a morph target of that mesh."""

    def materials(self, value: Value) -> Sequence[Any]:
        """Of a material, which one program may have in several."""

    def image(self, value: Value) -> Any:
        """Of a picture: PNG or JPEG."""

    def left_out(self, problem: InputError) -> None:
        """Note a part that is not kept."""


Convert = Callable[[Value, Links], Any]


def _text(value: Value, links: Links) -> str:
    return value.text()


def _number(value: Value, links: Links) -> Any:
    value.number()
    return value.data


def _flag(value: Value, links: Links) -> bool:
    return value.flag()


def _joint(value: Value, links: Links) -> Any:
    return links.joint(value)


def _mesh(value: Value, links: Links) -> Any:
    return links.mesh(value)


def _numbers(count: int) -> Convert:
    def convert(value: Value, links: Links) -> list[Any]:
        value.numbers(count)
        return [one.data for one in value.items()]

    return convert


def _choice(*options: str) -> Convert:
    def convert(value: Value, links: Links) -> str:
        if value.text() not in options:
            raise value.error(f"{quote(value.text())}, expected {' or '.join(options)}")
        return value.text()

    return convert


def _version(value: Value, links: Links) -> str:
    # the betas have the same fields, and runtimes read them alike
    _choice(VERSION, "1.0-beta")(value, links)
    return VERSION


def _fields(required: Sequence[str] = (), /, **table: Convert) -> Convert:
    """An object of these fields; others, and those that are wrong, are left out.

    :param required: without which the whole object is wrong
    """

    def convert(value: Value, links: Links) -> Json:
        result: Json = {}
        for key, data in value.members().items():
            if key not in table:
                links.left_out(value.error(f"{quote(key)} is no field that is kept"))
                continue
            try:
                result[key] = table[key](Value(data, f"{value.trail}.{key}"), links)
            except InputError as problem:
                if key in required:
                    raise
                links.left_out(problem)
        for key in required:
            if key not in result:
                raise value.error(f"no {key}, expected one")
        return result

    return convert


def _each(convert: Convert) -> Convert:
    """A list, without the items that are wrong; where `convert` gives lists, one of all theirs."""

    def listed(value: Value, links: Links) -> list[Any]:
        result: list[Any] = []
        for item in value.items():
            try:
                made = convert(item, links)
            except InputError as problem:
                links.left_out(problem)
            else:
                result += made if isinstance(made, list) else [made]
        return result

    return listed


def _called(convert: Convert, known: Callable[[str], bool]) -> Convert:
    """An object whose fields have names of their own, without those that `known` refuses or that are wrong."""

    def named(value: Value, links: Links) -> Json:
        result: Json = {}
        for name, data in value.members().items():
            one = Value(data, f"{value.trail}[{quote(name)}]")
            try:
                Value(name, value.trail).name()
                if not known(name):
                    raise one.error("is no name that VRM 1.0 has here")
                result[name] = convert(one, links)
            except InputError as problem:
                links.left_out(problem)
        return result

    return named


_BIND = _fields(("node", "weight"), node=_mesh, index=lambda one, _: None, weight=_number)


def _morph(value: Value, links: Links) -> Json:
    mesh, target = value.require("node"), value.require("index")
    bind: Json = _BIND(value, links)
    return bind | {"index": links.target(mesh, target)}


def _of_material(required: Sequence[str] = (), **table: Convert) -> Convert:
    """A bind of a material: one for each that the material is."""
    fields = _fields(required, material=lambda one, _: None, **table)

    def convert(value: Value, links: Links) -> list[Json]:
        bind = fields(value, links)
        return [bind | {"material": one} for one in links.materials(value.require("material"))]

    return convert


def _meta(value: Value, links: Links) -> Json:
    """Terms: each field as VRM has it."""
    result: Json = {}
    for key, data in value.members().items():
        one = Value(data, f"{value.trail}.{quote(key)[1:-1]}")
        if data in (None, "", [], [""]):  # as good as not there
            continue
        try:
            wrong = "is not kept" if key in ("extensions", "extras") else fault(key, data)
            if wrong is not None:
                raise one.error(wrong)
            if key == "thumbnailImage":
                result[key] = links.image(one)
                continue
            for text in data if isinstance(data, list) else [data] if isinstance(data, str) else []:
                Value(text, one.trail).text()
            result[key] = data
        except InputError as problem:
            links.left_out(problem)
    return result


_RANGE = _fields(inputMaxValue=_number, outputScale=_number)
_OVERRIDE = _choice("none", "block", "blend")
_COLORS = ("color", "emissionColor", "shadeColor", "matcapColor", "rimColor", "outlineColor")
_EXPRESSION = _fields(
    morphTargetBinds=_each(_morph),
    materialColorBinds=_each(_of_material(("type", "targetValue"), type=_choice(*_COLORS), targetValue=_numbers(4))),
    textureTransformBinds=_each(_of_material(scale=_numbers(2), offset=_numbers(2))),
    isBinary=_flag,
    overrideBlink=_OVERRIDE,
    overrideLookAt=_OVERRIDE,
    overrideMouth=_OVERRIDE,
)
_ANNOTATION = _fields(("node", "type"), node=_mesh, type=_choice("auto", "both", "thirdPersonOnly", "firstPersonOnly"))
_AVATAR = _fields(
    ("specVersion",),
    specVersion=_version,
    meta=_meta,
    humanoid=_fields(humanBones=_called(_fields(("node",), node=_joint), PARENTS.__contains__)),
    firstPerson=_fields(meshAnnotations=_each(_ANNOTATION)),
    lookAt=_fields(
        offsetFromHeadBone=_numbers(3),
        type=_choice("bone", "expression"),
        rangeMapHorizontalInner=_RANGE,
        rangeMapHorizontalOuter=_RANGE,
        rangeMapVerticalDown=_RANGE,
        rangeMapVerticalUp=_RANGE,
    ),
    expressions=_fields(
        preset=_called(_EXPRESSION, PRESETS.__contains__),
        custom=_called(_EXPRESSION, lambda name: name not in PRESETS),
    ),
)

_SPHERE, _CAPSULE = {"offset": _numbers(3), "radius": _number}, {"tail": _numbers(3)}
_SHAPE = _fields(sphere=_fields(**_SPHERE), capsule=_fields(**_SPHERE, **_CAPSULE))
_OTHER_SHAPE = _fields(  # of colliders that keep inside, and planes
    sphere=_fields(**_SPHERE, inside=_flag),
    capsule=_fields(**_SPHERE, **_CAPSULE, inside=_flag),
    plane=_fields(offset=_numbers(3), normal=_numbers(3)),
)
_COLLIDER = _fields(
    ("node", "shape"),
    node=_joint,
    shape=_SHAPE,
    extensions=_fields(**{COLLIDERS: _fields(("shape",), specVersion=_version, shape=_OTHER_SHAPE)}),
)
_SPRING_JOINT = _fields(
    ("node",),
    node=_joint,
    hitRadius=_number,
    stiffness=_number,
    gravityPower=_number,
    gravityDir=_numbers(3),
    dragForce=_number,
)
_CONSTRAINT = _fields(
    ("specVersion", "constraint"),
    specVersion=_version,
    constraint=_fields(
        roll=_fields(("source", "rollAxis"), source=_joint, rollAxis=_choice("X", "Y", "Z"), weight=_number),
        aim=_fields(
            ("source", "aimAxis"),
            source=_joint,
            aimAxis=_choice(*(f"{sign}{axis}" for sign in ("Positive", "Negative") for axis in "XYZ")),
            weight=_number,
        ),
        rotation=_fields(("source",), source=_joint, weight=_number),
    ),
)


def _numbered(value: Value | None, convert: Convert, links: Links) -> tuple[list[Any], Convert]:
    """The items of a list, and what becomes of references to them: those left out renumber the others."""
    kept: list[Any] = []
    places: dict[int, int] = {}
    for number, item in enumerate([] if value is None else value.items()):
        try:
            one = convert(item, links)
        except InputError as problem:
            links.left_out(problem)
        else:
            places[number] = len(kept)
            kept.append(one)

    def reference(value: Value, _: Links) -> int:
        if value.integer() not in places:
            raise value.error(f"{value.integer()}, but nothing of that number is kept")
        return places[value.integer()]

    return kept, reference


def _springs(value: Value, links: Links) -> Json:
    colliders, collider = _numbered(value.get("colliders"), _COLLIDER, links)
    group = _fields(name=_text, colliders=_each(collider))
    groups, group_number = _numbered(value.get("colliderGroups"), group, links)
    spring = _fields(
        ("joints",), name=_text, joints=_each(_SPRING_JOINT), colliderGroups=_each(group_number), center=_joint
    )
    made = {"colliders": lambda *_: colliders, "colliderGroups": lambda *_: groups, "springs": _each(spring)}
    result: Json = _fields(("specVersion",), specVersion=_version, **made)(value, links)
    return result


_CONVERTERS: Mapping[str, Convert] = {EXTENSION: _AVATAR, SPRINGS: _springs, CONSTRAINT: _CONSTRAINT}


def converted(name: str, value: Value, links: Links) -> Json:
    """The extension `name` with its references as `links` has them, and nothing that the specification doesn't know.

    :raises InputError: another version, or no object
    """
    made: Json = _CONVERTERS[name](value, links)
    return made


def section(vrm: Mapping[str, object], *path: str) -> Json:
    """An object within what a stage keeps; empty where there is none."""
    found: object = vrm
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return dict(found) if isinstance(found, Mapping) else {}

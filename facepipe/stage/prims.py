"""Prims of a face: schemas on them, values put there, those below a prim, their exact names, where opinions may stand.

USD builds its schema registry once, at first use. In a process that opened a stage before the schemas were there, USD
neither applies them nor has their attributes; here both work alike, and write the same.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import facepipe_schemas
from pxr import Sdf, Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.names import unique_identifiers
from facepipe.core.policy.bounds import check_counts
from facepipe.parts import Mesh, Named, exact

SKEL_PROPERTIES = (
    "primvars:skel:jointIndices",
    "primvars:skel:jointWeights",
    "primvars:skel:geomBindTransform",
    "skel:skeleton",
    "skel:animationSource",
    "skel:joints",
    "skel:blendShapes",
    "skel:blendShapeTargets",
)
_INSTANCE = "__INSTANCE_NAME__"  # in the names of a multiple-apply schema's attributes
MOST_PRIMS = 200_000  # a few lines of instances of instances make more prims than memory holds

INSTANCES = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


def authored_skel_properties(prim: Usd.Prim) -> list[str]:
    """The skel properties that a prim has itself."""
    authored = set(prim.GetAuthoredPropertyNames())
    return [name for name in SKEL_PROPERTIES if name in authored]


Known = dict[str, dict[Sdf.Path, Any]]  # property -> prim -> what was found to hold there


def inherited_attribute(prim: Usd.Prim, name: str, known: Known | None = None) -> Usd.Attribute | None:
    """An attribute with a value, of the prim or the nearest one above that has it.

    :param known: what was found before on a stage that has not changed since; filled in
    """

    def attribute_on(prim: Usd.Prim) -> Usd.Attribute | None:
        attribute = prim.GetAttribute(name)
        return attribute if attribute and attribute.HasAuthoredValue() else None

    return _nearest(prim, attribute_on, {} if known is None else known.setdefault(name, {}))


def inherited_skeleton(prim: Usd.Prim, known: Known | None = None) -> Sdf.Path | None:
    """What skel:skeleton of the prim or the nearest one above names, whether it is there or not; `known` as above."""

    def skeleton_on(prim: Usd.Prim) -> Sdf.Path | None:
        relationship = prim.GetRelationship("skel:skeleton")
        named = relationship.GetForwardedTargets() if relationship else []
        return named[0] if named else None

    return _nearest(prim, skeleton_on, {} if known is None else known.setdefault("skel:skeleton", {}))


def _nearest(prim: Usd.Prim, value_on: Callable[[Usd.Prim], Any], known: dict[Sdf.Path, Any]) -> Any:
    above, nearest = [], None
    while nearest is None and prim and not prim.IsPseudoRoot():
        path = prim.GetPath()
        if path in known:
            nearest = known[path]
            break
        above.append(path)
        nearest = value_on(prim)
        prim = prim.GetParent()
    known.update(dict.fromkeys(above, nearest))
    return nearest


def is_applied(prim: Usd.Prim, schema: str) -> bool:
    """Whether a single-apply schema is on the prim."""
    return schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def instances(prim: Usd.Prim, schema: str) -> list[str]:
    """Names under which a multiple-apply schema is on the prim."""
    prefix = f"{schema}:"
    applied = map(str, prim.GetPrimTypeInfo().GetAppliedAPISchemas())
    return [schema.removeprefix(prefix) for schema in applied if schema.startswith(prefix)]


def apply_schema(prim: Usd.Prim, schema: str, instance: str = "") -> None:
    """Put a schema on the prim, of a multiple-apply one the instance."""
    prim.AddAppliedSchema(f"{schema}:{instance}" if instance else schema)


def remove_schema(prim: Usd.Prim, schema: str, instance: str = "") -> None:
    """Take a schema, or an instance of it, off the prim; its attributes stay."""
    prim.RemoveAppliedSchema(f"{schema}:{instance}" if instance else schema)


def schema_attribute(prim: Usd.Prim, name: str) -> Usd.Attribute:
    """An attribute of the prim to write; created where it is one of our schemas that USD doesn't know."""
    attribute = prim.GetAttribute(name)
    if attribute:
        return attribute
    known, words = _attributes(), name.split(":")
    # the name of an instance stands between the two words before it and the attribute's own
    declared = known.get(name) or known.get(":".join([*words[:2], _INSTANCE, words[-1]]))
    return attribute if declared is None else prim.CreateAttribute(name, declared[0], False, declared[1])


def put(attribute: Usd.Attribute, value: Any) -> None:
    """Set the one value of an attribute, in place of all time samples; None hides what weaker layers say."""
    if value is None:
        if attribute and attribute.HasAuthoredValue():
            attribute.Block()
        return
    attribute.Clear()
    attribute.Set(value)


def put_value(prim: Usd.Prim, name: str, value: Any) -> None:
    """Set the one value of an attribute of our schemas, in place of all time samples; None hides what weaker layers
    say."""
    put(prim.GetAttribute(name) if value is None else schema_attribute(prim, name), value)


@functools.cache
def _attributes() -> dict[str, tuple[Sdf.ValueTypeName, Sdf.Variability]]:
    return {
        str(attribute.name): (attribute.typeName, attribute.variability)
        for prim in _layer().rootPrims
        for attribute in prim.attributes
    }


@functools.cache
def _layer() -> Sdf.Layer:
    return Sdf.Layer.FindOrOpen(str(facepipe_schemas.path() / "generatedSchema.usda"))


_RESERVED_SUFFIX = ":indices"


def check_property_name(where: object, kind: str, name: str, schema: str | None = None) -> None:
    """Check the name of a primvar, or of an instance of a multiple-apply `schema`.

    :raises InputError: a name that USD can't hold
    """
    if not Sdf.Path.IsValidNamespacedIdentifier(name) or name.endswith(_RESERVED_SUFFIX):
        raise InputError(where, f"{kind} '{name}', expected letters, digits, underscores and no digit first")
    declared = _layer().GetPrimAtPath(f"/{schema}").attributes if schema else ()
    # USD would take `prefix:indices` of an instance called `indices` for the attribute of the schema
    if name.rpartition(":")[2] in {attribute.name.rpartition(":")[2] for attribute in declared}:
        raise InputError(where, f"{kind} '{name}' is the name of a property of {schema}, expected another")


def prims_below(prim: Usd.Prim, where: object) -> Iterator[Usd.Prim]:
    """`prim` and all below it, those of instances as proxies.

    :param where: the trail for the error
    :raises InputError: more than `MOST_PRIMS`
    """
    for number, below in enumerate(Usd.PrimRange(prim, INSTANCES)):
        if number >= MOST_PRIMS:
            raise InputError(where, f"more than {MOST_PRIMS} prims, expected a face")
        yield below


def check_kinds(prims: Iterable[Usd.Prim], where: object) -> None:
    """:raises InputError: more prims of a kind than a face can have"""
    check_counts(where, Counter(str(prim.GetTypeName()) for prim in prims))


def editable(prim: Usd.Prim, *, below: bool = False) -> Usd.Prim:
    """The prim at the same path where opinions count: instances that it stands in are no longer instanced.

    :param below: for opinions on prims below it too
    """
    stage, path = prim.GetStage(), prim.GetPath()
    while prim.IsInstanceProxy() or (below and prim.IsInstance()):
        instance = prim
        while instance.IsInstanceProxy() or not instance.IsInstance():
            instance = instance.GetParent()
        instance.SetInstanceable(False)
        prim = stage.GetPrimAtPath(path)
    return prim


def free_path(face: Usd.Prim, folder: str, name: str) -> Sdf.Path:
    """A path in a scope of a face for what is called as its prim: that of a deactivated prim where there is one."""
    path = face.GetPath().AppendChild(folder)
    scope = face.GetStage().GetPrimAtPath(path) or UsdGeom.Scope.Define(face.GetStage(), path).GetPrim()
    children = {str(child.GetName()): child for child in editable(scope, below=True).GetAllChildren()}
    if name in children and not children[name].IsActive():
        children.pop(name).SetActive(True)
    return path.AppendChild(unique_identifiers([*children, name])[-1])


def exact_name(prim: Usd.Prim) -> str:
    """What the prim is called: its ``displayName``, else its own name."""
    return str(prim.GetDisplayName() if prim.HasAuthoredDisplayName() else prim.GetName())


def label(prim: Usd.Prim, name: str) -> str | None:
    """The label of what is called `name` on the prim; None where that is the prim's exact name."""
    own = exact_name(prim)
    return own if own != name else None


def author_name(prim: Usd.Prim, one: Named) -> None:
    """Write the exact name of a part on its prim, where the prim has another."""
    if exact_name(prim) != exact(one):
        prim.SetDisplayName(exact(one))


def author_data_label(prim: Usd.Prim, mesh: Mesh) -> None:
    """Write the source's name of a mesh's geometry, where it has one."""
    if mesh.data_label is not None:
        prim.SetCustomDataByKey(tokens.DATA_LABEL, mesh.data_label)


def data_label(prim: Usd.Prim) -> str | None:
    """The source's name of a mesh's geometry, where it has one of its own."""
    value = prim.GetCustomDataByKey(tokens.DATA_LABEL)
    return value if isinstance(value, str) else None


def distinct_names(prims: Sequence[Usd.Prim], paths: Sequence[str]) -> list[str]:
    """The exact names of prims; of those that share one, or have none, the prims' own, or identifiers of their paths,
    that nothing else is called."""
    names, prim_names = [exact_name(prim) for prim in prims], [str(prim.GetName()) for prim in prims]
    count, prim_count = Counter(name for name in names if name), Counter(prim_names)
    single = [name for name in names if count[name] == 1]
    rows = zip(names, prim_names, paths, strict=True)
    shared = [own if prim_count[own] == 1 else path for name, own, path in rows if count[name] != 1]
    others = iter(unique_identifiers([*single, *shared])[len(single) :])
    return [name if count[name] == 1 else next(others) for name in names]

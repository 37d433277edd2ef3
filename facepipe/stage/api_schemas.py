"""facepipe's API schemas on prims, by their metadata and attributes.

USD builds its schema registry once, at first use. In a process that opened a stage before the schemas were there, USD
neither applies them nor has their attributes; here both work alike, and write the same.
"""

from __future__ import annotations

import functools
from typing import Any

import facepipe_schemas
from pxr import Sdf, Usd

from facepipe.core.errors import InputError

_INSTANCE = "__INSTANCE_NAME__"  # in the names of a multiple-apply schema's attributes


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
    declared = None if attribute else _attributes().get(_declared_name(name))
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


def _is_reserved(schema: str, instance: str) -> bool:
    """Whether no instance of a multiple-apply schema can have a name, since an attribute of the schema has it."""
    last = instance.rpartition(":")[2]
    return any(
        attribute.name.rpartition(":")[2] == last for attribute in _layer().GetPrimAtPath(f"/{schema}").attributes
    )


def _declared_name(name: str) -> str:
    """The name in the schema: that of an instance stands between the two words before it and the attribute's own."""
    words = name.split(":")
    return name if name in _attributes() else ":".join([*words[:2], _INSTANCE, words[-1]])


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
    if schema and _is_reserved(schema, name):
        raise InputError(where, f"{kind} '{name}' is the name of a property of {schema}, expected another")

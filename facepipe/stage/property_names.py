"""Names that become part of property names."""

from __future__ import annotations

from pxr import Sdf

from facepipe.core.errors import InputError
from facepipe.stage.api_schemas import is_reserved

_RESERVED_SUFFIX = ":indices"


def check_property_name(where: object, what: str, name: str, schema: str | None = None) -> None:
    """Check the name of a primvar, or of an instance of a multiple-apply `schema`.

    :raises InputError: a name that USD can't hold
    """
    if not Sdf.Path.IsValidNamespacedIdentifier(name) or name.endswith(_RESERVED_SUFFIX):
        raise InputError(where, f"{what} '{name}', expected letters, digits, underscores and no digit first")
    if schema and is_reserved(schema, name):
        raise InputError(where, f"{what} '{name}' is the name of a property of {schema}, expected another")

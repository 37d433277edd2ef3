"""Names of any text on prims: the prim's own where it is that, else its ``displayName``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pxr import Usd

from facepipe.core import tokens
from facepipe.core.names import unique_identifiers
from facepipe.parts import Mesh, Named, exact


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


def told_apart(prims: Sequence[Usd.Prim], paths: Sequence[str]) -> list[str]:
    """The exact names of prims; of those that share one, or have none, the prims' own, or identifiers of their paths,
    that nothing else is called."""
    names, own = [exact_name(one) for one in prims], Counter(str(one.GetName()) for one in prims)
    count = Counter(name for name in names if name)
    single = [name for name in names if count[name] == 1]
    places = zip(names, prims, paths, strict=True)
    shared = [str(one.GetName()) if own[one.GetName()] == 1 else path for name, one, path in places if count[name] != 1]
    others = iter(unique_identifiers([*single, *shared])[len(single) :])
    return [name if count[name] == 1 else next(others) for name in names]

"""Prims of a face: those below a prim, their exact names, and where opinions on one may be authored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from pxr import Sdf, Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.names import unique_identifiers
from facepipe.core.policy.bounds import check_counts
from facepipe.parts import Mesh, Named, exact

MOST_PRIMS = 200_000  # a few lines of instances of instances make more prims than memory holds

INSTANCES = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


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

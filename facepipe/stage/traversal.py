"""Prims below a prim, instances included, up to a number that a face can have."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from pxr import Usd

from facepipe.core.errors import InputError

MOST_PRIMS = 200_000  # a few lines of instances of instances make more prims than memory holds

# of a face, of the kinds that each take a good part of a millisecond to read
MOST_OF = {"BlendShape": 10_000, "Shader": 8192, "NodeGraph": 8192, "Material": 4096, "Mesh": 4096, "GeomSubset": 4096}

INSTANCES = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


def prims_below(prim: Usd.Prim, where: object) -> Iterator[Usd.Prim]:
    """`prim` and all below it, those of instances as proxies.

    :param where: the trail for the error
    :raises InputError: more than `MOST_PRIMS`
    """
    for number, one in enumerate(Usd.PrimRange(prim, INSTANCES)):
        if number >= MOST_PRIMS:
            raise InputError(where, f"more than {MOST_PRIMS} prims, expected a face")
        yield one


def check_kinds(prims: Iterable[Usd.Prim], where: object) -> None:
    """:raises InputError: more prims of a kind than a face can have"""
    for kind, count in Counter(str(one.GetTypeName()) for one in prims).items():
        if count > MOST_OF.get(kind, MOST_PRIMS):
            raise InputError(where, f"{count} prims of type {kind}, expected at most {MOST_OF[kind]}")

"""Prims below a prim, instances included, up to a number that a face can have."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Usd

from facepipe.errors import InputError

MOST_PRIMS = 200_000  # a few lines of instances of instances make more prims than memory holds

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

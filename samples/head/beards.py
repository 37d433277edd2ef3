"""Beards: how each is combed, and the cards that it is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from hair import Layer, Style
from locks import SHORT
from scipy.spatial import cKDTree
from skin_maps import Template, step

from facepipe.heads.hairlines import bearded

Array = Any
_UPPER = -4.1  # height of the mouth, cm


def styles(template: Template, zone: Array) -> dict[str, tuple[Style, ...]]:
    """Beards by name: what grows above the mouth, which the lower jaw leaves behind, and what grows around it.

    :param zone: (n,) how far points of the template are in the zone of the beard
    """
    tree = cKDTree(template.points)

    def inside(name: str, upper: bool) -> Callable[[Array], Array]:
        def found(at: Array) -> Array:
            above = (at[:, 1] > _UPPER) & (np.abs(at[:, 0]) < 3.2) & (at[:, 2] > 8.0)
            share = zone[tree.query(at)[1]] * bearded(name, at)
            return np.where(above == upper, 2.5 * share - 0.7, -1.0)

        return found

    upper = {name: _moustache(inside(name, True)) for name in ("moustache", "goatee", "full")}
    return {
        "moustache": (upper["moustache"],),
        "goatee": (_jaw(inside("goatee", False), 0.4), upper["goatee"]),
        "full": (_jaw(inside("full", False), 1.0), upper["full"]),
    }


def _chin(at: Array) -> Array:
    """(n,) 1 on the chin, 0 on cheeks."""
    return step(4.5, 2.0, np.abs(at[:, 0])) * step(5.0, 8.0, at[:, 2])


def _jaw(grows: Callable[[Array], Array], share: float) -> Style:
    """Down and to the front, longer on the chin."""
    return Style(
        way=lambda at: np.column_stack([0.03 * at[:, 0], -1 + 0 * at[:, 0], 0.3 + 0 * at[:, 0]]),
        grows=grows,
        rise=1.6,
        length=lambda at: 1.5 + 1.1 * _chin(at),
        height=lambda at: 0.3 + 0.75 * _chin(at),
        layers=(
            Layer(count=int(200 * share), locks=SHORT[:2], rows=4, width=1.3, height=0.4, spread=0.15, inside=0.4),
            Layer(count=int(260 * share), locks=SHORT[1:5], rows=4, width=1.1, height=0.75, spread=0.2, inside=0.2),
            Layer(count=int(200 * share), locks=SHORT[3:6], rows=4, width=0.9, height=1.0, spread=0.3, roll=0.3),
        ),
    )


def _moustache(grows: Callable[[Array], Array]) -> Style:
    """From the middle outwards and down."""
    return Style(
        way=lambda at: np.column_stack([0.9 * np.tanh(at[:, 0] / 0.3), -0.75 + 0 * at[:, 0], 0 * at[:, 0]]),
        grows=grows,
        rise=0.8,
        rigid=True,
        length=lambda at: 1.0 + 0.15 * np.abs(at[:, 0]),
        height=lambda at: 0.22 + 0 * at[:, 0],
        layers=(
            Layer(count=60, locks=SHORT[:2], rows=3, width=0.8, height=0.5, spread=0.15),
            Layer(count=80, locks=SHORT[1:5], rows=3, width=0.65, height=0.9, spread=0.2),
            Layer(count=50, locks=SHORT[3:6], rows=3, width=0.6, height=1.2, spread=0.3, roll=0.3),
        ),
    )

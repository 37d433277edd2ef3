"""Cards of hairs: in lower levels whole ones go, and those that stay keep their form."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import components, edges, point_areas

_FEWEST = 16  # cards of a mesh that are taken as such
_BORDER = 0.5  # share of a card's points that lie on its border, or more
_WIDEST = 3.0  # times as wide as it was
_STANDS_IN = 0.75  # power of the share of cards that stay by which they are wider: they lie several deep


def cards_of(points: FloatArray, triangles: IntArray, mesh: IntArray) -> IntArray:
    """(t,) which card a triangle belongs to, -1 for none: cards are open pieces with more border than inside.

    :param points: (n, 3)
    :param triangles: (t, 3) of them
    :param mesh: (t,) which mesh each is of
    """
    pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
    piece = components(len(points), pairs)
    on_border = np.zeros(len(points), bool)
    on_border[pairs[uses == 1]] = True
    open_pieces = np.bincount(piece, on_border) >= _BORDER * np.bincount(piece)
    triangle_piece = piece[triangles[:, 0]]
    number, first = np.unique(triangle_piece, return_index=True)
    is_card = np.zeros(piece.max(initial=-1) + 1, bool)
    is_card[number] = open_pieces[number]
    enough = np.bincount(mesh[first], is_card[number], minlength=mesh.max(initial=-1) + 1) >= _FEWEST
    return np.where(is_card[triangle_piece] & enough[mesh], triangle_piece, -1)


def apart(points: FloatArray, triangles: IntArray, card: IntArray) -> IntArray:
    """(k,) the cards in an order in which the first are always spread over all of them, the first the largest one.

    :param card: (t,) which card each triangle (t, 3) is of
    """
    number, at = np.unique(card, return_inverse=True)
    corners = points[triangles].reshape(len(triangles), 9)
    low, high = np.full((len(number), 9), np.inf), np.full((len(number), 9), -np.inf)
    np.minimum.at(low, at, corners)
    np.maximum.at(high, at, corners)
    boxes = np.hstack([low.reshape(-1, 3, 3).min(axis=1), high.reshape(-1, 3, 3).max(axis=1)])
    chosen, away = [int((boxes[:, 3:] - boxes[:, :3]).sum(axis=1).argmax())], np.full(len(boxes), np.inf)
    while len(chosen) < len(boxes):
        away = np.minimum(away, np.linalg.norm(boxes - boxes[chosen[-1]], axis=1))
        away[chosen] = -1.0
        chosen.append(int(away.argmax()))
    return np.asarray(number[chosen])


def within(card: IntArray, order: IntArray, most: int) -> BoolArray:
    """(t,) triangles of the first cards of an order, so many that they have at most `most` triangles, but one card."""
    counts = np.bincount(card, minlength=int(order.max()) + 1)[order]
    kept = order[: max(1, int(np.searchsorted(np.cumsum(counts), most, side="right")))]
    return np.isin(card, kept)


def widened(points: FloatArray, triangles: IntArray, card: IntArray, share: float) -> FloatArray:
    """(n, 3) points whose cards are wider, to stand for all of them: 1 of `share` times, but `_WIDEST` at most.

    The long sides of a card go apart, each to its outside.

    :param triangles: (t, 3) of the cards that stay
    :param card: (t,) which card each is of
    :param share: of the cards that stay
    """
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = np.sort(sides, axis=1)
    at, uses = np.unique(keys[:, 0] * len(points) + keys[:, 1], return_inverse=True, return_counts=True)[1:]
    border = np.flatnonzero(uses[at] == 1)
    ends, of_card = sides[border], card[np.repeat(np.arange(len(triangles)), 3)[border]]
    along = points[ends[:, 1]] - points[ends[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), np.finfo(float).tiny)
    outside = points[ends[:, 0]] - points[triangles[:, [2, 0, 1]].ravel()[border]]
    outside -= along * (np.einsum("ec,ec->e", outside, along) / length**2)[:, None]
    place = _lengthwise(len(points), triangles, card)
    weight = np.abs(place[ends[:, 1]] - place[ends[:, 0]]) / np.maximum(np.linalg.norm(outside, axis=1), 1e-12)
    push = np.zeros_like(points)
    for side in ends.T:
        np.add.at(push, side, outside * weight[:, None])
    push /= np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-12)
    around = np.bincount(of_card, length, int(card.max()) + 1)
    owner = np.zeros(len(points), np.int64)
    owner[triangles] = card[:, None]
    area = np.bincount(owner, point_areas(points, triangles), len(around))
    # 2 (l + w) = around and l w = area, so 4 w = around - sqrt(around^2 - 16 area); rounding may take the root below 0
    width = (around - np.sqrt(np.maximum(around**2 - 16 * area, 0))) / 4  # of a rectangle with that border and area
    factor = min(share**-_STANDS_IN, _WIDEST)
    return np.asarray(points + (0.5 * (factor - 1) * width)[owner][:, None] * push)


def _lengthwise(count: int, triangles: IntArray, card: IntArray) -> FloatArray:
    """(count,) how far along its card a point is: the slowest vibration of the card's edges (Fiedler 1973)."""
    along = np.zeros(count)
    order = np.argsort(card, kind="stable")
    for rows in np.split(triangles[order], np.flatnonzero(np.diff(card[order])) + 1):
        points, corners = np.unique(rows, return_inverse=True)
        corners = corners.reshape(-1, 3)
        joined = np.zeros((len(points), len(points)))
        joined[corners, np.roll(corners, 1, axis=1)] = joined[np.roll(corners, 1, axis=1), corners] = 1.0
        along[points] = np.linalg.eigh(np.diag(joined.sum(axis=1)) - joined)[1][:, 1]
    return along

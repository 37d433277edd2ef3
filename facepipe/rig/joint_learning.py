"""Joints and skin weights that carry example faces of one topology: who people are, as bones.

    minimise  sum_s sum_i c_i^2 |sum_j w_ij (M_sj - 1)(r_i - c_j) + sum_k a_sk m_ki - d_si|^2  +  ridge |M_s - 1|^2

over places c of the joints, weights w on the simplex (few above 0 a point), and in every example s the bone
coefficients M and the weights a of modes m that a payload has beside the joints, in turns: coefficients and modes by
least squares, angles and scales as they are at rest; weights by a small convex problem a point, over the joints that
are near it; places in the middle of their weights. It is skinning decomposition (Le & Deng, "Smooth Skinning
Decomposition with Rigid Bones", 2012) with nine channels a joint, and all joints solved for at once. Modes that are
fitted first instead of with the joints leave 0.65 mm of a blend where these leave 0.48.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.skin_decomposition import largest, neighbour_means, on_simplex
from facepipe.rig.identity_joints import LEVER, IdentityJoints, coefficients_of_steps, joint_ways

_NEAR = 20  # joints that a point may have: twice the influences at least
_LLOYD_ROUNDS = 20  # in which first places settle
_FALL = 1.5  # exponent of a first weight at the distance of the fourth joint
_RIDGE, _MODE_RIDGE = 1e-4, 1e-5  # of what a channel, or a mode, moves on average
_PULL = 1e-3  # to the neighbours' weights, of the mean square of what joints are to carry
_EVEN = 1e-3  # of the neighbours' weights in what counts as large: it decides between joints that do nothing
_TURNS = 8  # in which turns and scales of coefficients settle, which are not quite linear
_SHARES = (1.0, 0.5, 0.25, 0.1)  # of a step, until one helps
_STAY = 1e-2  # ridge of coefficients, of what a channel moves on average
_POINTS_AT_ONCE = 1000  # of the weights' systems: a bound on memory


@dataclass(frozen=True, kw_only=True)
class LearntJoints:
    """j joints for n points."""

    places: FloatArray  # (j, 3)
    indices: IntArray  # (n, k) of a point, its largest weight first
    weights: FloatArray  # (n, k), in sum 1


def learn_joints(
    points: FloatArray,
    edges: IntArray,
    offsets: FloatArray,
    *,
    count: int,
    influences: int,
    rounds: int,
    care: FloatArray | None = None,
    modes: FloatArray | None = None,
    step: Callable[[], object] = lambda: None,
) -> LearntJoints:
    """Places and weights of joints that carry offsets.

    :param points: (n, 3) at rest, millimetres
    :param edges: (e, 2) neighbours
    :param offsets: (s, n, 3) of every example; each counts by itself, however large
    :param count: of joints
    :param influences: of them a point, at most
    :param rounds: of coefficients and weights
    :param care: (n,) above 0, how much a point counts; None: all alike
    :param modes: (k, n, 3) that examples may have beside joints; None: none
    :param step: called after every round
    """
    care = np.ones(len(points)) if care is None else care
    size = np.sqrt((offsets**2).sum(axis=2).mean(axis=1))
    wanted = offsets / np.maximum(size, 1e-12)[:, None, None]
    neighbours = neighbour_means(edges, len(points))
    places = _spread(points, care * np.sqrt((wanted**2).sum(axis=2).mean(axis=0)), count)
    near = min(max(_NEAR, 2 * influences), count)
    apart, candidates = cKDTree(places).query(points, np.arange(1, near + 1))
    weights = np.exp(-_FALL * (apart / np.maximum(apart[:, min(3, near - 1)], 1e-9)[:, None]) ** 2)
    weights = np.where(largest(weights, influences), weights, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    before: FloatArray = np.zeros((0, 0))
    for number in range(rounds):
        linear, rest = _fitted(points, places, candidates, weights, wanted, care, modes)
        weights = _weights(points, linear, candidates, weights, rest, influences, neighbours)
        table: FloatArray = np.zeros((len(points), count))
        np.put_along_axis(table, candidates, weights, axis=1)
        found = table
        if 0 < number < rounds - 1:
            table = _beyond(before, found, number)
        before = found
        held = table * care[:, None]
        total = held.sum(axis=0)[:, None]
        places = np.where(total > 0, held.T @ points / np.maximum(total, 1e-12), places)
        apart, closest = cKDTree(places).query(points, np.arange(1, near + 1))
        rank = 10.0 * (table > 0)  # those that a point has stay, the nearest join them
        np.put_along_axis(rank, closest, np.take_along_axis(rank, closest, axis=1) + 1 / (1 + apart), axis=1)
        candidates = np.argsort(-rank, axis=1, kind="stable")[:, :near]
        weights = np.take_along_axis(table, candidates, axis=1)
        step()
    order = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    indices, weights = (np.take_along_axis(values, order, axis=1) for values in (candidates, weights))
    return LearntJoints(places=places, indices=np.where(weights > 0, indices, 0), weights=weights)


def _beyond(before: FloatArray, weights: FloatArray, number: int) -> FloatArray:
    """Weights (n, j) as far beyond those of this round as a step of Nesterov's goes; what is 0 stays so.

    Rounds creep along valleys, where joints give way to each other: of faces that nine known joints made, 15 that go on
    from here leave as much as 40 that go on from where the last one ended. More joints where first ones leave most help
    people by 6 % more, and lose such known ones.
    """
    ahead = np.where(weights > 0, np.maximum(weights + number / (number + 3) * (weights - before), 0.0), 0.0)
    return np.asarray(ahead / ahead.sum(axis=1, keepdims=True))


def fitted_coefficients(joints: IdentityJoints, offsets: FloatArray) -> FloatArray:
    """(s, j, 9) bone coefficients by which joints come near to offsets (s, n, 3) of their points, in millimetres.

    With the slopes at rest, and steps that are halved until they help: turns of a radian throw whole steps far off. A
    ridge a hundredth as large leaves a tenth less of people, by turns of 2 radians and scales below 0.
    """
    ways, sizes = joints.ways, (len(joints.places), 9)
    whole = (ways.T @ ways).toarray()
    ridge = _STAY * np.trace(whole) / len(whole) + np.finfo(np.float64).tiny
    inverse = np.linalg.inv(whole + ridge * np.eye(len(whole)))
    result = []
    for wanted in offsets:

        def left(steps: FloatArray, wanted: FloatArray = wanted) -> tuple[FloatArray, float]:
            """(3 n,) what the joints leave, and its squares with the ridge."""
            rest = (wanted - joints.offsets(coefficients_of_steps(steps.reshape(sizes), 1.0))).ravel()
            return rest, float(rest @ rest + ridge * steps @ steps)

        steps = np.zeros(len(whole))
        rest, cost = left(steps)
        for _ in range(_TURNS):
            way = inverse @ (ways.T @ rest - ridge * steps)
            for share in _SHARES:
                ahead = left(steps + share * way)
                if ahead[1] < cost:
                    break
            else:
                break
            steps, (rest, cost) = steps + share * way, ahead
        result.append(coefficients_of_steps(steps.reshape(sizes), 1.0))
    return np.array(result)


def _spread(points: FloatArray, shares: FloatArray, count: int) -> FloatArray:
    """(count, 3) places among points, closer where shares (n,) are large: farthest ones first, then means."""
    apart, place, found = np.full(len(points), np.inf), int(np.argmax(shares)), []
    for _ in range(count):
        found.append(points[place])
        apart = np.minimum(apart, ((points - points[place]) ** 2).sum(axis=1))
        place = int((apart * shares).argmax())
    places = np.array(found)
    for _ in range(_LLOYD_ROUNDS):
        own = cKDTree(places).query(points)[1]
        total = np.bincount(own, shares, count)
        sums = np.stack([np.bincount(own, shares * axis, count) for axis in points.T], axis=1)
        places = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-12)[:, None], places)
    return places


def _fitted(
    points: FloatArray,
    places: FloatArray,
    candidates: IntArray,
    weights: FloatArray,
    wanted: FloatArray,
    care: FloatArray,
    modes: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """(j, s, 3, 4) by which joints alone move homogeneous points, and (s, n, 3) what modes leave for them to do."""
    heavy = np.repeat(care, 3)[:, None]
    ways = joint_ways(points, places, candidates, weights) * heavy
    beside = np.zeros((len(heavy), 0)) if modes is None else modes.reshape(len(modes), -1).T * heavy
    blocks = [(ways.T @ ways).toarray(), beside.T @ beside]
    for block, ridge in zip(blocks, (_RIDGE, _MODE_RIDGE), strict=True):
        block[np.diag_indices(len(block))] += ridge * np.trace(block) / max(len(block), 1) + np.finfo(np.float64).tiny
    across = ways.T @ beside
    goal = wanted.reshape(len(wanted), -1).T * heavy
    found = np.linalg.solve(
        np.block([[blocks[0], across], [across.T, blocks[1]]]), np.vstack([ways.T @ goal, beside.T @ goal])
    )
    split = len(blocks[0])
    rest = wanted if modes is None else wanted - np.tensordot(found[split:].T, modes, axes=1)
    channels = found[:split].reshape(len(places), 9, -1).transpose(0, 2, 1)
    linear = np.zeros((*channels.shape[:2], 3, 4))
    for axis in range(3):
        ahead, behind = (axis + 1) % 3, (axis + 2) % 3
        linear[..., behind, ahead] = channels[..., 3 + axis] / LEVER
        linear[..., ahead, behind] = -channels[..., 3 + axis] / LEVER
        linear[..., axis, axis] = channels[..., 6 + axis] / LEVER
    linear[..., 3] = channels[..., :3] - np.einsum("jsab,jb->jsa", linear[..., :3], places)
    return linear, rest


def _weights(
    points: FloatArray,
    linear: FloatArray,
    candidates: IntArray,
    start: FloatArray,
    wanted: FloatArray,
    most: int,
    neighbours: Any,
) -> FloatArray:
    """(n, c) weights of the candidates with which joints come nearest to (s, n, 3), at most so many above 0.

    What a point's candidates do is linear in its place: their products are of (4, 4) that all points share.
    """
    whole, flat = np.column_stack([points, np.ones(len(points))]), linear.reshape(len(linear), -1, 4)
    shared = np.einsum("jra,krb->jkab", flat, flat, optimize=True)
    gram, goal = np.empty((*candidates.shape, candidates.shape[1])), np.empty(candidates.shape)
    for first in range(0, len(points), _POINTS_AT_ONCE):
        some = slice(first, first + _POINTS_AT_ONCE)
        pairs = shared[candidates[some][:, :, None], candidates[some][:, None, :]]
        gram[some] = np.einsum("ia,ikqab,ib->ikq", whole[some], pairs, whole[some], optimize=True)
    for joint, own in enumerate(flat):
        rows, slots = np.nonzero(candidates == joint)
        theirs = wanted[:, rows].transpose(0, 2, 1).reshape(-1, len(rows))
        goal[rows, slots] = np.einsum("ai,ia->i", own.T @ theirs, whole[rows])
    pull = _PULL * float((wanted**2).sum() / len(points))
    diagonal = np.arange(candidates.shape[1])
    gram[:, diagonal, diagonal] += pull

    def beside(weights: FloatArray) -> FloatArray:
        """(n, c) what neighbours have on average."""
        table = np.zeros((len(points), len(linear)))
        np.put_along_axis(table, candidates, weights, axis=1)
        return np.take_along_axis(neighbours @ table, candidates, axis=1)

    goal += pull * beside(start)
    every = on_simplex(gram, goal, start, np.ones(start.shape, bool))
    chosen = largest(every + _EVEN * beside(every), most)
    kept = np.where(chosen, every, 0.0)
    return on_simplex(gram, goal, kept / kept.sum(axis=1, keepdims=True), chosen)

"""How the points of a face move, as few numbers a point: what fewer triangles are to keep beside its form."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from facepipe.core.arrays import FloatArray
from facepipe.core.threads import one_thread
from facepipe.rig import Rig

_TURN = 0.2  # radians by which joints are taken to turn
_WEIGHT = 15.0  # of an error in motion against one in form: with more, low levels lose their form


def motion_of(rig: Rig, most: int) -> FloatArray:
    """(n, k) coordinates of each point, in the unit of the rig, k at most `most`.

    The principal components of the offsets of all sculpts and of the ways that joints move points, scaled so that
    squared differences are `_WEIGHT` squared times those of the offsets themselves, summed over all sculpts.
    """
    sculpts = [sparse.csr_array(rig.deltas[axis::3]) for axis in range(3)] if rig.targets else []
    columns = sparse.csr_array(sparse.hstack([*sculpts, _by_joints(rig)]))
    with one_thread():
        values, vectors = np.linalg.eigh((columns.T @ columns).toarray())
    strongest = np.argsort(-values, kind="stable")[:most]
    return np.asarray(_WEIGHT * (columns @ vectors[:, strongest]))


def _by_joints(rig: Rig) -> sparse.csr_array:
    """(n, j) how far a turn of each joint takes the points, on average over those that follow it, by their weights."""
    weights = sparse.csr_array(rig.influences[:, : len(rig.joints)])
    distances = np.zeros(len(rig.joints))
    for joint, inverse in enumerate(rig.inverse_bind):
        share = weights[:, [joint]].toarray().ravel()
        place = np.linalg.inv(inverse)[:3, 3]
        total = share.sum()
        if total > 0:
            distances[joint] = (share * np.linalg.norm(rig.points - place, axis=1)).sum() / total
    return sparse.csr_array(weights @ sparse.diags_array(_TURN * distances))

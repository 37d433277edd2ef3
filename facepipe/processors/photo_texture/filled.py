"""Colours of the whole skin from those that photos show: seamless, by Poisson's equation on the surface.

Of the colours u at points, as logarithms of ratios to the template's,

    sum_i a_i w_i / l^2 (u_i - c_i)^2 + sum_ij k_ij (u_i - u_j - g_ij)^2

is least: u follows the observed c where confidence w is high (over the length l), and the gradients g elsewhere: those
of the mirrored side where that was seen, and 0, the template's own, where neither was. k are cotangent weights, a areas
(Perez, Gangnet, Blake, "Poisson Image Editing", SIGGRAPH 2003, on a surface: seams of texture coordinates are none).
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.factor import factorise
from facepipe.processors.photo_texture.skin_surface import SkinSurface

_NEAR = 0.02  # of the eyes' distance: l
_FAR = 0.8  # over which what is unseen goes to the skin's median colour
_INSIDE = 0.15  # over which the mouth's inside and the sockets go to the template's own colour


def filled(skin: SkinSurface, colors: FloatArray, trust: FloatArray) -> FloatArray:
    """(n, 3) colours of all points from those (n, 3) seen with confidence (n,)."""
    from scipy.sparse import csr_array, diags_array

    edges, weights = skin.edges
    mirror, known = np.maximum(skin.mirror, 0), skin.mirror >= 0
    one, other = edges.T
    seen = np.minimum(trust[one], trust[other])
    mirrored = (1 - seen) * np.minimum(np.where(known, trust[mirror], 0)[one], np.where(known, trust[mirror], 0)[other])
    differences = seen[:, None] * (colors[one] - colors[other])
    differences += mirrored[:, None] * (colors[mirror[one]] - colors[mirror[other]])
    flow = weights[:, None] * differences
    count = len(colors)
    incidence = csr_array(
        (np.tile([1.0, -1.0], len(edges)), (np.repeat(np.arange(len(edges)), 2), edges.ravel())),
        shape=(len(edges), count),
    )
    middle = _median(colors, trust * skin.areas)
    pulls = (
        (trust**2 * skin.areas / _NEAR**2, colors),
        (skin.areas / _FAR**2 * (1 - trust) * skin.outside, middle[None]),
        (skin.areas / _INSIDE**2 * ~skin.outside, np.zeros((1, 3))),
    )
    right = incidence.T @ flow + sum(weight[:, None] * target for weight, target in pulls)
    system = skin.laplacian + diags_array(sum(weight for weight, _ in pulls) + 1e-9)
    return factorise(system).solve(right)


def _median(colors: FloatArray, weight: FloatArray) -> FloatArray:
    middles = []
    for channel in colors.T:
        order = np.argsort(channel, kind="stable")
        sums = np.cumsum(weight[order])
        middles.append(channel[order][np.searchsorted(sums, 0.5 * sums[-1])] if sums[-1] > 0 else 0.0)
    return np.array(middles)

"""The 68 Multi-PIE landmarks on the MakeHuman base mesh (hm08), found by eye on renders.

Picture: docs/makehuman_landmarks.png. The jaw line follows the silhouette seen from the front.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.core.errors import InputError
from facepipe.importers.makehuman_data import MakeHumanData

# fmt: off
BASE_VERTICES = (  # vertex numbers of base.obj, 0-based
    # jaw line, from the subject's right ear to the left
    5237, 269, 270, 5241, 893, 3697, 922, 5292, 5296,
    11898, 7624, 10365, 7595, 11850, 7039, 7038, 11846,
    261, 225, 222, 223, 208, 6983, 6997, 6996, 6999, 7030,  # brows
    132, 131, 201, 297, 333, 314, 317, 7077, 7095,  # nose: bridge, tip, then nostrils
    21, 0, 54, 67, 47, 41, 6851, 6838, 6784, 6805, 6825, 6831,  # eyes: outer corner of the right one first
    422, 447, 460, 466, 7219, 7207, 7182, 7130, 11939, 492, 5335, 370,  # outer lips
    428, 470, 474, 7226, 7188, 7236, 493, 481,  # inner lips
)
# fmt: on


def landmark_points(data: MakeHumanData) -> IntArray:
    """(68,) int32 indices into the skin points.

    :raises InputError: a vertex of the table is not in the skin
    """
    numbers = data["source_vertex_index"][data.points_of("skin")]
    order = np.argsort(numbers, kind="stable")
    place = np.searchsorted(numbers, BASE_VERTICES, sorter=order)
    found = order[np.minimum(place, len(order) - 1)]
    missing = numbers[found] != np.array(BASE_VERTICES)
    if missing.any():
        number = BASE_VERTICES[int(np.argmax(missing))]
        raise InputError(f"{data.path} -> source_vertex_index", f"vertex {number} of base.obj is not in the skin")
    return found.astype(np.int32)

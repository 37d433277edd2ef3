"""The eleven classes of a face's pixels, and how the classes of others map to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError

# In the order of the photo fit's source; left and right are the person's.
CLASSES = (
    *("background", "face", "hair", "leftBrow", "rightBrow", "leftEye", "rightEye"),
    *("nose", "upperLip", "teeth", "lowerLip"),
)

# The channels of BiSeNet networks for face parsing, trained on CelebAMask-HQ.
CELEBAMASK = (
    *("background", "skin", "l_brow", "r_brow", "l_eye", "r_eye", "eye_g", "l_ear", "r_ear", "ear_r"),
    *("nose", "mouth", "u_lip", "l_lip", "neck", "neck_l", "cloth", "hair", "hat"),
)

# Glasses, ears and earrings are on the face; the neck and what is worn are behind it.
_OF_OTHERS = {
    "skin": "face",
    "eye_g": "face",
    "l_ear": "face",
    "r_ear": "face",
    "ear_r": "face",
    "neck": "background",
    "neck_l": "background",
    "cloth": "background",
    "hat": "background",
    "l_brow": "leftBrow",
    "r_brow": "rightBrow",
    "l_eye": "leftEye",
    "r_eye": "rightEye",
    "u_lip": "upperLip",
    "mouth": "teeth",
    "l_lip": "lowerLip",
}


def class_matrix(labels: Sequence[str]) -> FloatArray:
    """(11, n) 1 where a channel named by `labels` (n,) is one of `CLASSES`, 0 elsewhere; several may be one class.

    :raises InputError: a label that is neither of `CLASSES` nor of `CELEBAMASK`
    """
    matrix = np.zeros((len(CLASSES), len(labels)))
    for channel, label in enumerate(labels):
        name = _OF_OTHERS.get(label, label)
        if name not in CLASSES:
            expected = ", ".join(dict.fromkeys([*CLASSES, *CELEBAMASK]))
            raise InputError("labels", f"{label!r}, expected one of {expected}")
        matrix[CLASSES.index(name), channel] = 1
    return matrix

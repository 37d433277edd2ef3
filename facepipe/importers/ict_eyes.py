"""Materials within the ICT-FaceKit eyeballs.

An eyeball is an opaque-looking shell (M_Sclera) over an inner ball (M_Iris); the model leaves cornea, iris and pupil to
textures that it doesn't ship. Without them the shell hides the iris, so that here the shell's faces over the iris
become a clear Cornea and the innermost faces of the iris a Pupil.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.importers.ict_model import IctModel
from facepipe.importers.ict_topology import MATERIALS, PARTS
from facepipe.importers.mesh_pieces import face_corners

IRIS_RADIUS = 0.6  # cm, across the axis of the eye, which looks along +Z
PUPIL_RADIUS = 0.22  # cm

_CAP = 0.1  # cm of depth at the front of an eyeball, the middle of which is on the axis


def face_materials(model: IctModel) -> IntArray:
    """(F,) index of every face's material in `ict_topology.MATERIALS`, -1 for none or an unknown one."""
    names = list(MATERIALS)
    number = np.array([names.index(name) if name in names else -1 for name in model.materials] + [-1])
    materials = number[model.face_material]
    for part in PARTS:
        if part.title.startswith("Eyeball"):
            faces = np.arange(*part.faces)
            side = part.title.rpartition(" ")[2].capitalize()
            radius = _off_axis(model, faces, model.neutral[slice(*part.points)])
            shell = materials[faces] == names.index(f"M_Sclera{side}")
            inner = materials[faces] == names.index(f"M_Iris{side}")
            materials[faces[shell & (radius < IRIS_RADIUS)]] = names.index("Cornea")
            materials[faces[inner & (radius < PUPIL_RADIUS)]] = names.index("Pupil")
    return materials


def _off_axis(model: IctModel, faces: IntArray, points: FloatArray) -> FloatArray:
    """Distance of every face's middle from the axis of the eye; infinite behind the eyeball's middle."""
    axis = points[points[:, 2] > points[:, 2].max() - _CAP, :2].mean(axis=0)
    corners = model.face_vertex_indices[face_corners(model.face_vertex_counts, faces)]
    starts = np.cumsum(model.face_vertex_counts[faces]) - model.face_vertex_counts[faces]
    middles = np.add.reduceat(model.neutral[corners], starts) / model.face_vertex_counts[faces][:, None]
    behind = middles[:, 2] < (points[:, 2].min() + points[:, 2].max()) / 2
    return np.where(behind, np.inf, np.linalg.norm(middles[:, :2] - axis, axis=1))

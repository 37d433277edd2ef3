"""The rig: the one definition of what a rig parameter does to the points of a face."""

from facepipe.rig.animation import sample_transforms, sample_weights
from facepipe.rig.bone_coefficients import CHANNELS, coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.build import build, mesh_spaces
from facepipe.rig.person import Person, person_of
from facepipe.rig.plausibility import implausible
from facepipe.rig.rig import Rig, Target
from facepipe.rig.set_face import SetFace, set_face
from facepipe.rig.sliders import slide

__all__ = [
    "CHANNELS",
    "Person",
    "Rig",
    "SetFace",
    "Target",
    "build",
    "coefficient_matrices",
    "implausible",
    "matrix_coefficients",
    "mesh_spaces",
    "person_of",
    "rest_coefficients",
    "sample_transforms",
    "sample_weights",
    "set_face",
    "slide",
]

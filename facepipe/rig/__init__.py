"""The rig: the one definition of what a rig parameter does to the points of a face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.rig.animation import sample_transforms, sample_weights
    from facepipe.rig.bone_coefficients import CHANNELS, coefficient_matrices, matrix_coefficients, rest_coefficients
    from facepipe.rig.plausibility import implausible
    from facepipe.rig.rig import Rig, Target, build, mesh_spaces
    from facepipe.rig.set_person import Person, SetFace, person_of, set_face, set_points
    from facepipe.rig.sliders import slide
else:
    __getattr__, __dir__ = lazy(__name__)

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
    "set_points",
    "slide",
]

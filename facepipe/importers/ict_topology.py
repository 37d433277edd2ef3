"""The fixed tables of the ICT-FaceKit topology: parts, shapes, materials, landmarks.

Source: README.md and FaceXModel/vertex_indices.json of ICT-FaceKit (MIT, USC Institute for Creative Technologies).
Ranges are half-open.
"""

from __future__ import annotations

from typing import NamedTuple

from facepipe.parts import Material

POINT_COUNT = 26719
FACE_COUNT = 26384
IDENTITY_MODES = 100


class Part(NamedTuple):
    """A run of points and faces that becomes (a piece of) one mesh, with the region that a loose one belongs to."""

    title: str
    mesh: str
    region: str
    points: tuple[int, int]
    faces: tuple[int, int]


# Face to eye sockets are welded: their faces share points. Head takes its regions point by point (`ict`).
PARTS = (
    Part("Face", "Head", "", (0, 9409), (0, 9230)),
    Part("Head and Neck", "Head", "", (9409, 11248), (9230, 11144)),
    Part("Mouth socket", "Head", "mouth", (11248, 13294), (11144, 13226)),
    Part("Eye socket left", "Head", "eyes", (13294, 13678), (13226, 13630)),
    Part("Eye socket right", "Head", "eyes", (13678, 14062), (13630, 14034)),
    Part("Gums and tongue", "GumsAndTongue", "mouth", (14062, 17039), (14034, 17006)),
    Part("Teeth", "Teeth", "mouth", (17039, 21451), (17006, 21496)),
    Part("Eyeball left", "EyeballLeft", "eyes", (21451, 23021), (21496, 23094)),
    Part("Eyeball right", "EyeballRight", "eyes", (23021, 24591), (23094, 24692)),
    Part("Lacrimal fluid left", "LacrimalFluidLeft", "eyes", (24591, 24795), (24692, 24855)),
    Part("Lacrimal fluid right", "LacrimalFluidRight", "eyes", (24795, 24999), (24855, 25018)),
    Part("Eye blend left", "EyeBlendLeft", "eyes", (24999, 25023), (25018, 25033)),
    Part("Eye blend right", "EyeBlendRight", "eyes", (25023, 25047), (25033, 25048)),
    Part("Eye occlusion left", "EyeOcclusionLeft", "eyes", (25047, 25199), (25048, 25176)),
    Part("Eye occlusion right", "EyeOcclusionRight", "eyes", (25199, 25351), (25176, 25304)),
    Part("Eyelashes left", "EyelashesLeft", "eyes", (25351, 26035), (25304, 25844)),
    Part("Eyelashes right", "EyelashesRight", "eyes", (26035, 26719), (25844, 26384)),
)

# fmt: off
EXPRESSIONS = (
    "browDown_L", "browDown_R", "browInnerUp_L", "browInnerUp_R", "browOuterUp_L", "browOuterUp_R",
    "cheekPuff_L", "cheekPuff_R", "cheekSquint_L", "cheekSquint_R",
    "eyeBlink_L", "eyeBlink_R", "eyeLookDown_L", "eyeLookDown_R", "eyeLookIn_L", "eyeLookIn_R",
    "eyeLookOut_L", "eyeLookOut_R", "eyeLookUp_L", "eyeLookUp_R", "eyeSquint_L", "eyeSquint_R",
    "eyeWide_L", "eyeWide_R", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthDimple_L", "mouthDimple_R", "mouthFrown_L", "mouthFrown_R", "mouthFunnel", "mouthLeft",
    "mouthLowerDown_L", "mouthLowerDown_R", "mouthPress_L", "mouthPress_R", "mouthPucker", "mouthRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthSmile_L", "mouthSmile_R",
    "mouthStretch_L", "mouthStretch_R", "mouthUpperUp_L", "mouthUpperUp_R", "noseSneer_L", "noseSneer_R",
)
EXTRAS = ("PupilDilate_L", "PupilDilate_R", "cheekRaiser_L", "cheekRaiser_R")

LANDMARKS = (  # multipie68
    1225, 1888, 1052, 367, 1719, 1722, 2199, 1447, 966, 3661, 4390, 3927, 3924, 2608, 3272, 4088, 3443,  # jaw line
    268, 493, 1914, 2044, 1401, 3615, 4240, 4114, 2734, 2509,  # brows
    978, 4527, 4942, 4857, 1140, 2075, 1147, 4269, 3360,  # nose
    1507, 1542, 1537, 1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732,  # eyes
    5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841,  # outer lips
    5702, 5711, 5533, 6216, 6207, 6470, 5517, 5966,  # inner lips
)
# fmt: on

ATTRIBUTION = (
    "ICT-FaceKit, Copyright (c) 2020 USC Institute for Creative Technologies, MIT license. Please cite: Li et al., "
    "Learning Formation of Physically-Based Face Attributes, CVPR 2020."
)

_SKIN = (0.60, 0.37, 0.28)

MATERIALS = {
    material.name: material
    for material in (
        Material(name="M_Face", diffuse_color=_SKIN, roughness=0.5),
        Material(name="M_BackHead", diffuse_color=_SKIN, roughness=0.5),
        Material(name="M_GumsTongue", diffuse_color=(0.50, 0.16, 0.15), roughness=0.35),
        Material(name="M_Teeth", diffuse_color=(0.78, 0.73, 0.62), roughness=0.25),
        Material(name="M_ScleraLeft", diffuse_color=(0.80, 0.77, 0.74), roughness=0.15),
        Material(name="M_ScleraRight", diffuse_color=(0.80, 0.77, 0.74), roughness=0.15),
        Material(name="M_IrisLeft", diffuse_color=(0.13, 0.08, 0.05), roughness=0.1),
        Material(name="M_IrisRight", diffuse_color=(0.13, 0.08, 0.05), roughness=0.1),
        Material(name="M_LacrimalFluid", diffuse_color=(0.0, 0.0, 0.0), roughness=0.05, opacity=0.1),
        Material(name="M_EyeBlend", diffuse_color=(0.55, 0.30, 0.25), roughness=0.3, opacity=0.2),
        Material(name="M_EyeOcclusion", diffuse_color=(0.05, 0.02, 0.02), roughness=0.9, opacity=0.15),
        Material(name="M_EyeLashes", diffuse_color=(0.02, 0.015, 0.01), roughness=0.8, opacity=0.15),
        Material(name="Cornea", diffuse_color=(0.0, 0.0, 0.0), roughness=0.02, opacity=0.05),  # see `ict`
        Material(name="Pupil", diffuse_color=(0.005, 0.005, 0.005), roughness=0.1),
    )
}

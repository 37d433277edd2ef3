"""Skin: a skeleton and smooth weights for a face that has none, from joint positions or from another face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.verbs.skin.from_examples import read_examples
    from facepipe.verbs.skin.from_joints import JointSet, JointSpec, read_joints
    from facepipe.verbs.skin.options import SkinOptions
    from facepipe.verbs.skin.skin import Skin
    from facepipe.verbs.skin.skin_face import SkinFace
    from facepipe.verbs.skin.skinning import SkinReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "JointSet",
    "JointSpec",
    "Skin",
    "SkinFace",
    "SkinOptions",
    "SkinReport",
    "read_examples",
    "read_joints",
]

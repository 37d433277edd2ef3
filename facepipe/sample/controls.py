"""Sliders and bone limits."""

from __future__ import annotations

import numpy as np

from facepipe.parts import BoneLimits, Skeleton, Slider
from facepipe.sample.rig import HEAD, JAW

Channel = tuple[str, str, float]


def _both(joint: str, channel: str, gain: float) -> tuple[Channel, Channel]:
    """A channel of a left joint and of its twin; what points sideways is mirrored."""
    sign = -1.0 if channel in ("tx", "ry", "rz") else 1.0
    return (f"{joint}Left", channel, gain), (f"{joint}Right", channel, sign * gain)


def _scaled(joint: str, gain: float) -> tuple[Channel, ...]:
    return tuple(entry for axis in ("sx", "sy", "sz") for entry in _both(joint, axis, gain))


def _slider(name: str, group: str, *channels: Channel) -> Slider:
    return Slider(name=name, group=group, minimum=-1.0, maximum=1.0, channels=channels)


def sliders() -> tuple[Slider, ...]:
    """Sliders over bones (-1..1, 0 is the neutral) and over shapes (0..1)."""
    nostril = f"{HEAD}/noseTip/nostril"
    upper, lower = f"{HEAD}/lipUpper", f"{JAW}/lipLower"
    lids = (*_both(f"{HEAD}/lidUpper", "tx", 0.25), *_both(f"{HEAD}/lidLower", "tx", 0.25))
    bones = (
        _slider("noseWidth", "nose", *_both(nostril, "tx", 0.3)),
        _slider("noseLength", "nose", (f"{HEAD}/noseTip", "ty", -0.4)),
        _slider("noseDepth", "nose", (f"{HEAD}/noseTip", "tz", 0.45)),
        _slider("noseBridge", "nose", (f"{HEAD}/noseBridge", "tz", 0.35)),
        _slider("jawWidth", "jaw", *_both(f"{JAW}/jowl", "tx", 0.6)),
        _slider("chinLength", "jaw", (f"{JAW}/chin", "ty", -0.6)),
        _slider("chinDepth", "jaw", (f"{JAW}/chin", "tz", 0.6)),
        _slider("eyeSize", "eyes", *(c for j in ("eye", "lidUpper", "lidLower") for c in _scaled(f"{HEAD}/{j}", 0.1))),
        _slider("eyeSpacing", "eyes", *_both(f"{HEAD}/eye", "tx", 0.25), *lids),
        _slider(
            "browHeight", "brows", *(c for j in ("Inner", "Mid", "Outer") for c in _both(f"{HEAD}/brow{j}", "ty", 0.4))
        ),
        _slider("browTilt", "brows", *_both(f"{HEAD}/browInner", "ty", -0.3), *_both(f"{HEAD}/browOuter", "ty", 0.35)),
        _slider(
            "cheekbones", "cheeks", *_both(f"{HEAD}/cheekUpper", "tz", 0.35), *_both(f"{HEAD}/cheekUpper", "tx", 0.3)
        ),
        _slider("cheekFullness", "cheeks", *_both(f"{HEAD}/cheekLower", "tx", 0.5)),
        _slider("mouthWidth", "mouth", *_both(f"{HEAD}/lipCorner", "tx", 0.4)),
        _slider("upperLipFullness", "mouth", (upper, "tz", 0.2), *_both(upper, "tz", 0.15)),
        _slider("lowerLipFullness", "mouth", (lower, "tz", 0.25), *_both(lower, "tz", 0.18)),
        _slider("earSize", "ears", *_scaled(f"{HEAD}/ear", 0.2)),
        _slider("earAngle", "ears", *_both(f"{HEAD}/ear", "ry", 0.35)),
    )
    return (*bones, *_expression_sliders())


def _expression_sliders() -> tuple[Slider, ...]:
    smile = (("mouthSmileLeft", 1.0), ("mouthSmileRight", 1.0), ("cheekSquintLeft", 0.5), ("cheekSquintRight", 0.5))
    frown = (("mouthFrownLeft", 1.0), ("mouthFrownRight", 1.0), ("browInnerUp", 0.5))
    blink = (("eyeBlinkLeft", 1.0), ("eyeBlinkRight", 1.0))
    named = (("smile", smile), ("frown", frown), ("blink", blink), ("mouthOpen", (("jawOpen", 1.0),)))
    return tuple(Slider(name=name, group="expression", shapes=shapes) for name, shapes in named)


def bone_limits(skeleton: Skeleton) -> BoneLimits:
    """Limits that keep the face whole: 0.8 cm, 0.4 rad and 30 % for face joints, wider turns for jaw, neck and eyes."""
    count = len(skeleton.joints)
    lower = np.tile(np.repeat([-0.8, -0.4, 0.7], 3), (count, 1))
    upper = np.tile(np.repeat([0.8, 0.4, 1.3], 3), (count, 1))
    for i, joint in enumerate(skeleton.joints):
        name = joint.rpartition("/")[2]
        if name in ("root", "neck", "head"):
            lower[i, :3], upper[i, :3] = 0.0, 0.0
            lower[i, 3:6], upper[i, 3:6] = -0.7, 0.7
        elif name == "jaw":
            lower[i, 3], upper[i, 3] = -0.05, 0.45
        elif name.startswith(("eye", "lid")):
            lower[i, 3:6], upper[i, 3:6] = -0.6, 0.6
    return BoneLimits(lower=lower, upper=upper)

"""Sliders and bone limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.parts import BoneLimits, Skeleton, Slider
from facepipe.rig.sliders import kept
from procedural_head.rig import HEAD, JAW

Channel = tuple[str, str, float]


def _both(joint: str, channel: str, gain: float) -> tuple[Channel, Channel]:
    """A channel of a left joint and of its twin; what points sideways is mirrored."""
    sign = -1.0 if channel in ("tx", "ry", "rz") else 1.0
    return (f"{joint}Left", channel, gain), (f"{joint}Right", channel, sign * gain)


def _scaled(joint: str, gain: float) -> tuple[Channel, ...]:
    return tuple(entry for axis in ("sx", "sy", "sz") for entry in _both(joint, axis, gain))


def _slider(name: str, group: str, *channels: Channel) -> Slider:
    return Slider(name=name, group=group, minimum=-1.0, maximum=1.0, channels=channels)


def _one_side(slider: Slider, side: str) -> Slider:
    """A slider of both sides, for one of them."""
    sides = {"Left": "Right", "Right": "Left"}
    mine = kept(slider, lambda joint: joint.endswith(side), lambda shape: shape.endswith(side))
    return replace(mine, name=f"{slider.name}{side}", mirror=f"{slider.name}{sides[side]}")


def sliders() -> tuple[Slider, ...]:
    """Sliders over bones (-1..1, 0 is the neutral) and over shapes (0..1); none is a mix of others."""
    both = (*_nose(), *_jaw(), *_eyes(), *_brows(), *_cheeks(), *_mouth(), *_ears_and_forehead())
    pairs = (_brow_arch(), _eye_open(), _mouth_corner())
    sided = [_one_side(slider, side) for slider in pairs for side in ("Left", "Right")]
    return (*both, *sided, *_expression_sliders())


def _nose() -> tuple[Slider, ...]:
    tip, nostril, bridge = f"{HEAD}/noseTip", f"{HEAD}/noseTip/nostril", f"{HEAD}/noseBridge"
    return (
        _slider("noseWidth", "nose", *_both(nostril, "tx", 0.3)),
        _slider("noseLength", "nose", (tip, "ty", -0.4)),
        _slider("noseDepth", "nose", (tip, "tz", 0.45)),
        _slider("noseBridge", "nose", (bridge, "tz", 0.35)),
        _slider("noseBridgeWidth", "nose", (bridge, "sx", 0.25)),
        _slider("noseTipTilt", "nose", (tip, "rx", -0.3)),
        _slider("noseTipSize", "nose", *((tip, axis, 0.2) for axis in ("sx", "sy", "sz"))),
        _slider("nostrilHeight", "nose", *_both(nostril, "ty", 0.2)),
    )


def _jaw() -> tuple[Slider, ...]:
    chin = f"{JAW}/chin"
    return (
        _slider("jawWidth", "jaw", *_both(f"{JAW}/jowl", "tx", 0.4), *_both(f"{HEAD}/cheekLower", "tx", 0.2)),
        _slider("jawAngle", "jaw", *_both(f"{JAW}/jowl", "ty", 0.5)),
        _slider("jawForward", "jaw", (JAW, "tz", 0.35)),
        _slider("chinLength", "jaw", (chin, "ty", -0.6)),
        _slider("chinDepth", "jaw", (chin, "tz", 0.6)),
        _slider("chinWidth", "jaw", (chin, "sx", 0.25)),
    )


def _eyes() -> tuple[Slider, ...]:
    parts = [f"{HEAD}/{part}" for part in ("eye", "lidUpper", "lidLower")]
    return (
        _slider("eyeSize", "eyes", *(c for part in parts for c in _scaled(part, 0.1))),
        _slider("eyeSpacing", "eyes", *(c for part in parts for c in _both(part, "tx", 0.15))),
        _slider("eyeHeight", "eyes", *(c for part in parts for c in _both(part, "ty", 0.25))),
        _slider("eyeDepth", "eyes", *(c for part in parts for c in _both(part, "tz", 0.25))),
        _slider("eyeTilt", "eyes", *(c for part in parts[1:] for c in _both(part, "rz", 0.2))),
    )


def _eye_open() -> Slider:
    """Lids go further down than up, the lower ones only when the eye closes."""
    upper, lower = _both(f"{HEAD}/lidUpper", "rx", -1.0), _both(f"{HEAD}/lidLower", "rx", 1.0)
    narrow, wide = ((-1.0, -0.2), (0.0, 0.0), (1.0, 0.12)), ((-1.0, -0.1), (0.0, 0.0))
    return replace(_slider("eyeOpen", "eyes", *upper, *lower), channel_curves=(narrow, narrow, wide, wide))


def _brows() -> tuple[Slider, ...]:
    inner, outer = f"{HEAD}/browInner", f"{HEAD}/browOuter"
    every = (inner, f"{HEAD}/browMid", outer)
    return (
        _slider("browHeight", "brows", *(c for brow in every for c in _both(brow, "ty", 0.4))),
        _slider("browDepth", "brows", *(c for brow in every for c in _both(brow, "tz", 0.3))),
        _slider("browTilt", "brows", *_both(inner, "ty", -0.3), *_both(outer, "ty", 0.35)),
        _slider("browSpacing", "brows", *_both(inner, "tx", 0.3)),
    )


def _brow_arch() -> Slider:
    return _slider("browArch", "brows", *_both(f"{HEAD}/browMid", "ty", 0.35))


def _cheeks() -> tuple[Slider, ...]:
    upper, lower = f"{HEAD}/cheekUpper", f"{HEAD}/cheekLower"
    return (
        _slider("cheekbones", "cheeks", *_both(upper, "tz", 0.35), *_both(upper, "tx", 0.3)),
        _slider("cheekHeight", "cheeks", *_both(upper, "ty", 0.45)),
        _slider("cheekFullness", "cheeks", *_both(lower, "tx", 0.3)),
        _slider("cheekDepth", "cheeks", *_both(lower, "tz", 0.4)),
    )


def _mouth() -> tuple[Slider, ...]:
    upper, lower, corner = f"{HEAD}/lipUpper", f"{JAW}/lipLower", f"{HEAD}/lipCorner"

    def everywhere(channel: str, gain: float) -> tuple[Channel, ...]:
        middles = ((upper, channel, gain), (lower, channel, gain))
        return (*middles, *(c for joint in (upper, lower, corner) for c in _both(joint, channel, gain)))

    return (
        _slider("mouthWidth", "mouth", *_both(corner, "tx", 0.4)),
        _slider("mouthHeight", "mouth", *everywhere("ty", 0.3)),
        _slider("mouthDepth", "mouth", *everywhere("tz", 0.3)),
        _slider("upperLipFullness", "mouth", (upper, "tz", 0.2), *_both(upper, "tz", 0.15)),
        _slider("lowerLipFullness", "mouth", (lower, "tz", 0.25), *_both(lower, "tz", 0.18)),
        _slider("cupidsBow", "mouth", (upper, "sx", 0.3), (upper, "sy", 0.3)),
    )


def _mouth_corner() -> Slider:
    return _slider("mouthCorner", "mouth", *_both(f"{HEAD}/lipCorner", "ty", 0.25))


def _ears_and_forehead() -> tuple[Slider, ...]:
    ear, forehead = f"{HEAD}/ear", f"{HEAD}/forehead"
    return (
        _slider("earSize", "ears", *_scaled(ear, 0.2)),
        _slider("earAngle", "ears", *_both(ear, "ry", 0.35)),
        _slider("earHeight", "ears", *_both(ear, "ty", 0.5)),
        _slider("earTilt", "ears", *_both(ear, "rx", 0.3)),
        _slider("foreheadDepth", "forehead", (forehead, "tz", 0.6)),
        _slider("foreheadHeight", "forehead", (forehead, "ty", 0.6)),
    )


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

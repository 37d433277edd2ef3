"""The error of formats that blend joints linearly, on meshes that are skinned by dual quaternions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.parts import FaceParts
from facepipe.rig.animation import sample_transforms, sample_weights
from facepipe.rig.build_rig import build

_POSES_MEASURED = 20  # of each animation, evenly spread


def linear_skinning_notes(parts: FaceParts) -> tuple[str, ...]:
    """A line for the report of a writer that blends joints linearly, where the face has meshes that don't."""
    names = [mesh.name for mesh in parts.meshes if mesh.skin is not None and mesh.skin.dual_quaternion]
    if not names:
        return ()
    owners = names[0] if len(names) == 1 else f"{len(names)} meshes"
    line = f"{owners}: skinned by dual quaternions, which the format lacks: skinned linearly in the file"
    rig = build(parts)
    linear = replace(rig, dual=None)
    apart, poses = 0.0, 0
    for animation in parts.animations:
        count = animation.samples
        for index in np.unique(np.linspace(0, count - 1, min(count, _POSES_MEASURED)).astype(np.int64)).tolist():
            local = sample_transforms(parts.skeleton, animation, index)
            weights = rig.weight_vector(
                {name: weight for name, weight in sample_weights(animation, index).items() if name in rig.shapes}
            )
            # the same points and weights in both: the distance is what the method alone makes
            pair = [either.evaluate(weights, joint_transforms=local) for either in (rig, linear)]
            apart = max(apart, float(np.linalg.norm(pair[0] - pair[1], axis=1).max(initial=0.0)))
            poses += 1
    if not poses:
        return (f"{line}; the face has no animation to measure the difference on",)
    return (f"{line}, up to {apart * parts.meters_per_unit * 1000:.3g} mm off over {poses} poses of its animations",)

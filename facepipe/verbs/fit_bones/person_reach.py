"""How near a person of the head in the box comes as what it is, by modes and identity joints, where bones miss it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts
from facepipe.verbs.fit_bones.targets import Target

_WITHIN_MM = 1.0  # as `facepipe person` has it where nothing is said


@dataclass(frozen=True, kw_only=True)
class PersonReach:
    """The payload that `facepipe person` writes of a target, beside bones alone, over the points that both bring."""

    bytes: int
    mean_mm: float
    bones_mean_mm: float


def person_reach(parts: FaceParts, target: Target, off: FloatArray) -> PersonReach | None:
    """What a payload makes of the target; None of a face that is not the head in the box, or lacks some of it.

    Joints of a face carry expressions: 44 of them leave millimetres of another person, whose modes take 220 bytes.

    :param parts: the fitted face
    :param target: another face, of one frame
    :param off: (n,) distances that bones leave, millimetres
    """
    from facepipe.verbs.person_basis import head_basis, is_head
    from facepipe.verbs.person_layers import encode_points
    from facepipe.verbs.whole_faces import MILLIMETRES, Topology, world_to_world

    if not is_head(parts, parts.name):
        return None
    basis, topology = head_basis(), Topology.of(parts)
    starts = dict(zip(topology.names, np.cumsum([0, *topology.points]), strict=False))
    rows = np.concatenate([starts[mesh.name] + np.arange(mesh.points) for mesh in basis.content.meshes])
    if target.known is not None and not target.known[rows].all():
        return None
    to_millimetres = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    points = transformed(target.points[0, rows], to_millimetres)
    data, layers = encode_points(basis, points, within=_WITHIN_MM)
    left = np.linalg.norm(layers[-1].points - points, axis=1)
    return PersonReach(bytes=len(data), mean_mm=float(left.mean()), bones_mean_mm=float(off[rows].mean()))

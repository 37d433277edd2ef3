"""A neural rig carried to another face of its topology, by deformation transfer of its shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.deformation_transfer import Transfer, spread
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build
from facepipe.rig.bone_coefficients import CHANNELS
from facepipe.rig.neural_rig import NeuralRig, bones_in, most_influences, output_reach, with_basis, with_influences
from facepipe.verbs.same_topology import MILLIMETRES, world_to_world
from facepipe.verbs.whole_faces import Topology, whole_points


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A face that has no rig of its own yet."""

    where: str
    topology: Topology
    rest: FloatArray  # (n, 3) millimetres, Y up
    bones: Rig | None  # of its skeleton, in millimetres; None without joints

    @classmethod
    def of(cls, parts: FaceParts, where: str) -> Subject:
        """The subject of a face stage."""
        rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
        bones = bones_in(rig, to) if rig.joints else None
        return cls(where=where, topology=Topology.of(parts), rest=whole_points(parts), bones=bones)

    def checked(self, rig: NeuralRig) -> Subject:
        """The same.

        :raises TopologyError: other meshes or joints than those of the rig
        """
        if self.topology.digest != rig.topology:
            raise TopologyError(self.where, "other meshes than those of the neural rig, expected its topology")
        joints = () if self.bones is None else self.bones.joints
        if rig.bones is not None and joints != rig.bones.joints:
            expected = f"expected the rig's {len(rig.bones.joints)} (facepipe skin --from gives a face another's)"
            raise TopologyError(self.where, f"{len(joints)} joints that are not those of the neural rig, {expected}")
        return self


def carried(rig: NeuralRig, subject: Subject) -> NeuralRig:
    """The rig on the subject: its own rest and bones, and shapes that take over the deformation.

    Translations of bones are brought to the subject's size.

    :raises TopologyError: other meshes or joints than those of the rig
    """
    subject.checked(rig)
    bones = None
    if rig.bones is not None and subject.bones is not None:
        bones = with_influences(subject.bones, most_influences(rig.bones))
    rest = subject.rest if bones is None else bones.points
    transfer = Transfer(rest, subject.topology.triangles, np.zeros(len(rest), bool))
    sizes = output_reach(rig)[: len(rig.shapes)]
    shapes = np.empty_like(rig.shapes)
    for number, (shape, size) in enumerate(zip(rig.shapes, sizes, strict=True)):
        there = rig.rest + size * shape
        shapes[number] = (transfer.solve(rig.rest[None], there[None]) - rest) / size
    scale = np.ones(len(rig.shapes) + len(rig.channels))
    moves = rig.channels[:, 1] < CHANNELS.index("rx")
    scale[len(rig.shapes) :][moves] = spread(rest) / spread(rig.rest)
    scaled = replace(
        rig,
        rest=rest,
        bones=bones,
        linear=rig.linear * scale,
        last=rig.last * scale[:, None],
        last_bias=rig.last_bias * scale,
    )
    return with_basis(scaled, shapes, np.zeros((len(rig.controls), *rest.shape)), 0.0, len(shapes))

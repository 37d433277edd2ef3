"""What the built-in head knows of itself when it is fitted to a scan: who people are, and what goes with their skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import FloatArray
from facepipe.geometry.identity_model import IdentityModel
from facepipe.parts import FaceParts
from facepipe.scanning.database import FaceDatabase, Update
from facepipe.verbs.whole_faces import Topology, whole_points

_TO_MM = 10.0  # its points are in centimetres
_TOLERANCE_MM = 0.1


@dataclass(frozen=True, kw_only=True)
class BuiltInHead:
    """A template that is the built-in head, with cards of hair or without."""

    parts: FaceParts  # of the template
    body: FaceParts  # the bare average head

    @classmethod
    def of(cls, parts: FaceParts) -> BuiltInHead | None:
        """None: the template is another face."""
        from facepipe.heads.asset import asset

        names = asset().parts
        known = parts.meshes[: len(names)]
        if [mesh.name for mesh in known] != list(names) or (parts.meters_per_unit, parts.up_axis) != (0.01, "Y"):
            return None
        from facepipe.heads.assembly import average

        body = average()
        alike = Topology.of(replace(parts, meshes=known)).digest == Topology.of(body).digest
        return cls(parts=parts, body=body) if alike else None

    def people(self) -> FaceDatabase:
        """Who people may be: the identity modes, as a database of nobody."""
        from facepipe.heads.assembly import modes

        identity = IdentityModel.from_modes(whole_points(self.body), _TO_MM * modes())
        return FaceDatabase(
            topology=Topology.of(self.body),
            identity=identity,
            coefficients=np.zeros((0, len(identity.deviations))),
            expressions=None,
            entries=(),
            history=(Update(version=1, verb="create", entries=(), facepipe=__version__),),
            tolerance_mm=_TOLERANCE_MM,
        )

    def fitted(self, points: FloatArray) -> FloatArray:
        """(n, 3) whole points of the bare head in millimetres, with eyeballs that fit lids, and a mouth behind skin."""
        from facepipe.heads.assembly import with_parts_fitted

        return _TO_MM * with_parts_fitted(points / _TO_MM)

    def settled(self, changed: FaceParts, *, blinks: bool = True) -> FaceParts:
        """The template with other points, whose blinks close its lids, and whose cards lie on its skin.

        :param blinks: made of the lids; else they stay as they are
        """
        from facepipe.heads.assembly import with_own_blinks, with_own_cards

        if blinks:
            body = changed.meshes[: len(self.body.meshes)]
            points = np.concatenate([np.asarray(mesh.points, np.float64) for mesh in body])
            changed = with_own_blinks(changed, points)
        return with_own_cards(changed, self.parts)

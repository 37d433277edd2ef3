"""How people differ, on a face of another topology than the built-in head's, such as a studio's own."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.geometry.identity_model import IdentityModel
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.built_in_head import of_nobody, people
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.carry import Carrier
from facepipe.scanning.transfer.fit import HeadFit, fit_head
from facepipe.scans import ScanLandmarks


@one_thread()
def people_on(template: Template) -> FaceDatabase:
    """Who people may be on a template's own topology.

    The built-in head is laid on the template's skin, and its identity modes go to where that lies. The mean is such
    that the template itself is the person of the fit's coefficients: what it has beyond all people, everyone has.

    :raises FitError: a template that shows no face
    """
    marks = ScanLandmarks(points=template.points[template.rows[template.landmarks]])
    skin = template.points[template.rows]
    head, known, fit = built_in_on(skin, template.triangles, marks, template.where)
    carrier, modes = Carrier(head, fit), []
    for deviation, component in zip(known.identity.deviations, known.identity.components, strict=True):
        moved = skin + carrier.laid(deviation * component[head.rows])
        modes.append(template.whole(template.points, moved) - template.points)
    own = np.tensordot(fit.report.coefficients, modes, axes=1)
    return of_nobody(template.topology, IdentityModel.from_modes(template.points - own, np.stack(modes)))


def built_in_on(
    points: FloatArray, triangles: IntArray, landmarks: ScanLandmarks, where: str
) -> tuple[Template, FaceDatabase, HeadFit]:
    """The built-in head without hair, who its people may be, and how it lies on a skin, as `fit_head` lays it.

    :raises FacepipeError: as `fit_head`
    """
    from facepipe.heads.assembly import average

    body = average()
    head, known = Template.of(body, "built-in head"), people(body)
    return head, known, fit_head(head, known, points, triangles, landmarks, name=where)

"""How people differ, on a face of another topology than the built-in head's, such as a studio's own."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.similarity import fit_similarity
from facepipe.parts import FaceParts
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.built_in_head import bare_head, of_nobody, people
from facepipe.scanning.rebuild.declared import UNITS
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.carry import Carrier
from facepipe.scanning.transfer.fit import fit_head
from facepipe.scans import ScanLandmarks

_TURNED = 30.0  # degrees: heads that look down or aside a little are none the worse
_LARGE = 2.0  # times: children have 0.7 of the size, and an inch is 2.5 centimetres


def people_of(
    template: Template, database: FaceDatabase | None = None, own: FaceParts | None = None
) -> tuple[Template, FaceDatabase]:
    """The template without hair and lashes, which people of a database lack, and who its people may be.

    :param database: None: those of the built-in head, carried over where the template has another topology
    :param own: `bare_head` of the template, where it is known
    :raises InputError: a template in another place or unit than its people
    :raises TopologyError: another topology than that of the database
    :raises FitError: a template that shows no face
    """
    if database is None:
        own = own or bare_head(template.parts)
        database = people_on(template) if own is None else people(own)
    body = template.body(database.topology)
    check_place(body, database.identity.mean[body.rows[body.landmarks]])
    return body, database


def check_place(template: Template, marks: FloatArray) -> None:
    """Check that a template stands upright, looks ahead and is in its unit: a fit to a scan, which finds turn and size,
    would not see it, and give figures in millimetres that are none.

    :param marks: (68, 3) landmarks of people, millimetres and Y up
    :raises InputError: it does not
    """
    off = fit_similarity(template.points[template.rows[template.landmarks]], marks)
    degrees = float(np.degrees(np.arccos(np.clip((np.trace(off.rotation) - 1.0) / 2.0, -1.0, 1.0))))
    if degrees > _TURNED:
        what = f"its face is turned by {degrees:.0f} degrees, expected upright and looking along Z, Y up, within"
        raise InputError(template.where, f"{what} {_TURNED:g}")
    if not 1.0 / _LARGE < off.scale < _LARGE:
        mm = 1000.0 * template.parts.meters_per_unit
        likely = [name for name, unit in UNITS.items() if 1.0 / _LARGE < unit / (mm * off.scale) < _LARGE]
        what = f"its face is {1.0 / off.scale:.3g} times as large as people's, expected {1.0 / _LARGE:g} to {_LARGE:g}"
        meant = f" (it would be in {' or '.join(likely)})" if likely else ""
        raise InputError(f"{template.where} -> metersPerUnit", f"{what}: a unit of {mm:g} mm may be wrong{meant}")


@one_thread()
def people_on(template: Template) -> FaceDatabase:
    """Who people may be on a template's own topology.

    The built-in head is laid on the template's skin, and its identity modes go to where that lies. The mean is such
    that the template itself is the person of the fit's coefficients: what it has beyond all people, everyone has.

    :raises InputError: a template that is turned or in another unit
    :raises FitError: a template that shows no face
    """
    head, known = built_in()
    check_place(template, head.points[head.rows[head.landmarks]])
    skin, marks = template.points[template.rows], template.points[template.rows[template.landmarks]]
    fit = fit_head(head, known, skin, template.triangles, ScanLandmarks(points=marks), name=template.where)
    carrier, modes = Carrier(head, fit), []
    for deviation, component in zip(known.identity.deviations, known.identity.components, strict=True):
        moved = skin + carrier.laid(deviation * component[head.rows])
        modes.append(template.whole(template.points, moved) - template.points)
    own = np.tensordot(fit.report.coefficients, modes, axes=1)
    return of_nobody(template.topology, IdentityModel.from_modes(template.points - own, np.stack(modes)))


def built_in() -> tuple[Template, FaceDatabase]:
    """The built-in head without hair, and who its people may be."""
    from facepipe.heads.assembly import average

    body = average()
    return Template.of(body, "built-in head"), people(body)

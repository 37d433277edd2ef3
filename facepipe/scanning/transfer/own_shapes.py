"""The own shapes of a head on a template that took its shape: what lies at one place moves alike.

On rims of lips and lids a fit is a millimetre off along the surface, where the nearest place may be on the other lip: a
corner of the mouth came out as a patch across it. There the template's own shape stands, as much of it as elsewhere,
with what the head's differs from that by around.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.threads import one_thread
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts, Landmarks
from facepipe.rig.conventions import match_shapes, shapes_of
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.carry import FADE_MM, Carrier, Fill, screened
from facepipe.scanning.transfer.finish import is_by_lids
from facepipe.scanning.transfer.fit import HeadFit
from facepipe.scanning.transfer.head import Head
from facepipe.scanning.transfer.marks import face_mesh, own_points
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.sides import banks_of
from facepipe.scans import LANDMARK_SCHEME
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import whole_face

# Of a slit's width from its rims: up to there the template's own shape stands. With 0.12 jawOpen of a person on a mesh
# of 3,018 points was 0.15 mm off instead of 0.25, and a corner of the mouth stayed shut.
_RIM = 0.3


@one_thread()
def bring_own_shapes(
    face: Face,
    giver: Head,
    place: Similarity,
    report: FitNeutralReport,
    step: Callable[[], object] = lambda: None,
) -> tuple[str, ...]:
    """Author on `face`, a template in the shape of a head, the shapes that the head has by any usual name, in place of
    the template's own; the names of these. Blinks, looks and wide eyes are of the template's own eyes, and stay.

    Loose parts outside, such as brows, go along with the skin; inside the head they move as in the template's own
    shape, by what share of it the skin does.

    :param giver: the head, with its landmarks
    :param place: from its whole points to the face's
    :param report: of the fit that laid the template on it
    :param step: called after each shape
    :raises FacepipeError: a damaged head
    """
    parts = face.parts()
    own = match_shapes(parts.shapes, giver.parts.shapes, shapes_of(giver.parts.meshes))
    own = {name: named for name, named in own.items() if not is_by_lids(name)}
    if not own:
        return ()
    taker = Template.of(parts, face.where)
    skin = taker.points[taker.rows]
    body = Template.of(_marked(giver, place.undo(skin[taker.landmarks])), giver.where)
    back = Similarity(
        rotation=place.rotation.T,
        translation=-place.translation @ place.rotation / place.scale,
        scale=1.0 / place.scale,
    )
    mesh = HeadMesh.of(back.apply(skin), taker.triangles)
    carrier = Carrier(body, HeadFit(points=body.points, place=back, head=mesh, report=report))
    known, inside = _known(taker) & carrier.reached[mesh.group], _inside(taker)
    fill = Fill(screened(skin, taker.triangles, FADE_MM), known)
    theirs, before = whole_face(body.parts, giver.where).deltas, whole_face(parts, face.where).deltas
    shapes = {}
    for name, named in own.items():
        carried = carrier.carry(np.sum([theirs[one] for one in named], axis=0))
        # by what share of the template's own the skin moves, so do the lining of the mouth, teeth and gums
        was = before[name][taker.rows]
        squares = max(float((was[known] ** 2).sum()), np.finfo(np.float64).tiny)
        share = float((was * carried)[known].sum()) / squares
        differs = fill.filled(carried - share * was)
        around = taker.whole(taker.points, skin + differs) - taker.points
        shapes[name] = share * before[name] + np.where(inside[:, None], 0.0, around)
        step()
    AuthorNeutral(shapes=shapes)(face, taker.points, recipe=parts.recipe)
    return tuple(shapes)


def _known(template: Template) -> BoolArray:
    """(m,) rows of the outside of the skin that are on no rim of a lip or lid."""
    known = np.zeros(len(template.rows), bool)
    known[template.seen] = True
    for bank in banks_of(template):
        known &= bank.away >= _RIM
    return known


def _inside(template: Template) -> BoolArray:
    """(n,) whole points of loose parts that lie nearest to what is not seen of the skin: teeth, gums, tongue, eyes."""
    from scipy.spatial import cKDTree

    hidden = np.ones(len(template.rows), bool)
    hidden[template.seen] = False
    inside = np.zeros(len(template.points), bool)
    if len(template.loose):
        near = cKDTree(template.points[template.rows]).query(template.points[template.loose])[1]
        piece = template.stiff[template.loose]
        inside[template.loose] = (np.bincount(piece, hidden[near]) > 0.5 * np.bincount(piece))[piece]
    return inside


def _marked(head: Head, marks: FloatArray) -> FaceParts:
    """The head with landmarks of its own points, those nearest to `marks` (68, 3) where it has none."""
    parts = head.parts
    if any(LANDMARK_SCHEME in mesh.landmarks for mesh in parts.meshes):
        return parts
    chosen, own, points = face_mesh(head, head.skin())
    indices = own[own_points(marks, points)]
    meshes = list(parts.meshes)
    landmarks = {**meshes[chosen].landmarks, LANDMARK_SCHEME: Landmarks(indices=indices.astype(np.int32))}
    meshes[chosen] = replace(meshes[chosen], landmarks=landmarks)
    return replace(parts, meshes=tuple(meshes))

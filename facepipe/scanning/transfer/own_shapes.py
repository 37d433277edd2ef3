"""The own shapes of a head on a template that took its shape: what lies at one place moves alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts, Landmarks
from facepipe.rig.conventions import match_shapes, shapes_of
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.carry import carried
from facepipe.scanning.transfer.fit import HeadFit
from facepipe.scanning.transfer.head import Head
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.transfer import own_jaw, own_points, whole_shapes, with_inbetweens
from facepipe.scans import LANDMARK_SCHEME
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import whole_face


@one_thread()
def bring_own_shapes(
    face: Face,
    giver: Head,
    place: Similarity,
    report: FitNeutralReport,
    step: Callable[[], object] = lambda: None,
) -> tuple[str, ...]:
    """Author on `face`, a template in the shape of a head, the shapes that the head has by any usual name, in place of
    the template's own; the names of these.

    No fit is needed: the two lie on one another. Shapes go over by their gradients and are finished as those of
    `facepipe transfer`, for the template's own eyes and teeth.

    :param giver: the head, with its landmarks
    :param place: from its whole points to the face's
    :param report: of the fit that laid the template on it
    :param step: called after each shape
    :raises FacepipeError: a damaged head
    """
    parts = face.parts()
    own = match_shapes(parts.shapes, giver.parts.shapes, shapes_of(giver.parts.meshes))
    if not own:
        return ()
    taker = Head.of(parts, face.where, None)
    skin = taker.skin()
    body = Template.of(_marked(giver, place.undo(taker.landmarks.points)), giver.where)
    deltas = whole_face(body.parts, giver.where).deltas
    nothing = np.zeros_like(body.points)
    wished = {name: sum((deltas[one] for one in named), nothing) for name, named in own.items()}
    back = Similarity(
        rotation=place.rotation.T,
        translation=-place.translation @ place.rotation / place.scale,
        scale=1.0 / place.scale,
    )
    mesh = HeadMesh.of(back.apply(taker.sewn[skin]), taker.surface.part_triangles(skin))
    fit = HeadFit(points=body.points, place=back, head=mesh, report=report)
    on_skin = carried(body, fit, wished, lambda name: _done(step)).deltas
    kept = {"jawOpen": "jawOpen"} if "jawOpen" not in wished and "jawOpen" in parts.shapes else {}
    made, _ = whole_shapes(taker, skin, body, fit, wished, on_skin, own_jaw(taker, kept, skin))

    def settled(changed: FaceParts) -> FaceParts:
        meshes = [
            replace(
                one,
                blendshapes=tuple(with_inbetweens(shape, taker, number, made.inbetweens) for shape in one.blendshapes),
            )
            for number, one in enumerate(changed.meshes)
        ]
        return replace(changed, meshes=tuple(meshes))

    shapes = {name: taker.whole(delta) for name, delta in made.deltas.items()}
    AuthorNeutral(shapes=shapes, settled=settled)(face, taker.points, recipe=parts.recipe)
    return tuple(shapes)


def _done(step: Callable[[], object]) -> None:
    step()


def _marked(head: Head, marks: FloatArray) -> FaceParts:
    """The head with landmarks of its own points, those nearest to `marks` (68, 3) where it has none."""
    parts = head.parts
    if any(LANDMARK_SCHEME in mesh.landmarks for mesh in parts.meshes):
        return parts
    counts = [len(mesh.points) for mesh in parts.meshes]
    pieces = np.split(np.isin(head.surface.group, head.skin()), np.cumsum(counts)[:-1])
    chosen = int(np.argmax([piece.sum() for piece in pieces]))
    own: IntArray = np.flatnonzero(pieces[chosen])
    indices = own[own_points(marks, head.points[sum(counts[:chosen]) + own])]
    meshes = list(parts.meshes)
    landmarks = {**meshes[chosen].landmarks, LANDMARK_SCHEME: Landmarks(indices=indices.astype(np.int32))}
    meshes[chosen] = replace(meshes[chosen], landmarks=landmarks)
    return replace(parts, meshes=tuple(meshes))

"""A closer look at a face that was found: larger pictures, and the network that sees faces larger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.pinhole import meeting_points
from facepipe.scanning.landmarks.search import Draw, FaceFrame, Seen

_PIXELS = 400  # a side
_MARGIN = 1.6  # sides of a crop that a picture shows
_MEETING = 0.012  # of a side: distance at which a ray counts half
_JAW, _COUNT = 17, 68


def look_closer(look: Look, frame: FaceFrame, seen: Seen, angles: Sequence[tuple[float, float]], draw: Draw) -> Seen:
    """Landmarks by views at `angles`; those of the jaw, which are no truer from near, stay as they were `seen`."""
    from facepipe.networks.dense_landmarks import dense_landmarks
    from facepipe.networks.files import own_dense_session
    from facepipe.rig.torch import torch

    views = [frame.view(yaw, pitch, _PIXELS, _MARGIN) for yaw, pitch in angles]
    origins, directions, errors = [], [], []
    for view in views:
        picture = torch.as_tensor(np.asarray(draw(look, view)[0], np.float32))
        found = dense_landmarks(own_dense_session(), picture, view.project(seen.landmarks)[0])
        if found is not None:
            origins.append(view.eye)
            directions.append(view.directions(found[0][_JAW:_COUNT]))
            errors.append(found[1][_JAW:_COUNT])
    if not origins:
        return seen
    weights = 1.0 / np.stack(errors) ** 2
    places, distances = meeting_points(np.stack(origins), np.stack(directions), weights, _MEETING * frame.side)
    landmarks, spread = np.array(seen.landmarks), np.array(seen.spread)
    landmarks[_JAW:], spread[_JAW:] = places, np.median(distances, axis=0) / frame.side
    return replace(seen, landmarks=landmarks, spread=spread)

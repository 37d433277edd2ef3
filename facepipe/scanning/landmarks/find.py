"""The 68 landmarks of a scanned face: searched from all around, then seen from several sides, and from nearer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError
from facepipe.core.reports import Report, not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.coarse_surface import Look, coarse_look, disc_look, filled_look, part_look, surface_look
from facepipe.geometry.pinhole import meeting_points
from facepipe.geometry.polygons import border_points
from facepipe.geometry.scan_surface import cloud_normals
from facepipe.scanning.clean_scan import CleanScan
from facepipe.scanning.landmarks.search import (
    Draw,
    FaceFrame,
    Network,
    Seen,
    axis_views,
    candidates,
    face_frame,
    is_worth_search,
    look_again,
    sphere_views,
)
from facepipe.scans import LANDMARK_COUNT, Scan, ScanLandmarks

_PIXELS = 400  # a side
_MARGIN = 1.6  # sides of a crop that a picture shows
_MEETING = 0.012  # of a side: distance at which a ray counts half
_JAW, _COUNT = 17, 68
_CELLS, _FINE_CELLS = 90, 200  # of a grid over the scan's width, and over a crop's side
_NEAR = 1.3  # of a crop's side: what pictures of the face show
_HOLES = 0.13  # of a crop's side: smaller ones, which would look like features, are closed
_MOST = 10  # candidates that are looked at again
_FIRST = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0))  # yaw and pitch, radians
_ALL = tuple((yaw, pitch) for pitch in (-0.1, 0.2) for yaw in (-0.5, -0.25, 0.0, 0.25, 0.5))
_CLOSER = tuple((yaw, 0.05) for yaw in (-0.5, -0.25, 0.0, 0.25, 0.5))
_SURE, _STEADY = 0.9, 0.02  # presence, and spread as a share of a side, of a face
_CERTAIN = 0.9  # score of a face beyond which no other is looked for
_UNSURE = 0.03  # of a side: spread of a landmark that is left out
_OFF = 0.03  # of a side: a landmark farther from the surface than this lies where the scan has ended
_END = 0.05  # of a side: the outline of a scan that ends nearer than this to the jaw's landmarks passes for the jaw
_BROWS = slice(17, 27)
_JAW_MM, _FEATURES_MM = 3.5, 0.8  # RMS along each coordinate, over simulated scans
# Of brows without colours, which are guessed, and with: off by 0.5, but nothing in the surface keeps them in place.
_GUESSED_MM, _SHOWN_MM = 1.5, 0.2


def look_closer(look: Look, frame: FaceFrame, seen: Seen, angles: Sequence[tuple[float, float]], draw: Draw) -> Seen:
    """Landmarks by views at `angles`; those of the jaw, which are no truer from near, stay as they were `seen`."""
    from facepipe.networks.files import dense_landmarks, own_dense_session
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
    # By 1 / error^2: a view that sees a landmark badly counts little.
    weights = 1.0 / np.stack(errors) ** 2
    places, distances = meeting_points(np.stack(origins), np.stack(directions), weights, _MEETING * frame.side)
    landmarks, spread = np.array(seen.landmarks), np.array(seen.spread)
    landmarks[_JAW:], spread[_JAW:] = places, np.median(distances, axis=0) / frame.side
    return replace(seen, landmarks=landmarks, spread=spread)


@dataclass(frozen=True, kw_only=True)
class ScanLandmarksReport(Report):
    """How landmarks were found."""

    found: int
    presence: float  # 0..1: how much it looks like a face, over all views
    spread: float  # median distance of a landmark's rays from it, over landmarks, share of the distance of the eyes
    searched: int  # views in which the face was searched
    landmarks: Any = not_in_json()  # the `FoundScanLandmarks`, of which pictures are drawn


@dataclass(frozen=True, kw_only=True)
class FoundScanLandmarks:
    """Landmarks of a scan."""

    landmarks: ScanLandmarks
    frame: FaceFrame  # where the face is, and how it stands
    look: Look  # what was looked at: the mended scan, of a cloud discs
    report: ScanLandmarksReport


@dataclass(frozen=True, kw_only=True)
class FindScanLandmarks:
    """Finds a face's landmarks on a scan of any pose and unit, with colours or without.

    Pictures from all around are searched for crops that the landmark network takes for a face; those are looked at from
    several sides, and again by the network of many landmarks. Each landmark is where the rays through it meet, brought
    onto the surface. Those whose rays disagree, or meet off the surface, are left out. It needs torch.

    :param draw: draws a surface: ``(look, view) -> picture, depth``, like `facepipe.pictures.surface_view.draw_surface`
    """

    draw: Draw

    @one_thread()
    def __call__(self, scan: Scan) -> FoundScanLandmarks:
        """Search `scan`.

        :raises FitError: no face on it
        :raises InputError: no surface, or no torch
        """
        from scipy.spatial import cKDTree

        import facepipe.rig.torch  # noqa: F401  (asked for before the work, not in the middle of it)
        from facepipe.geometry.closest_points import closest_places
        from facepipe.networks.files import own_landmark_session

        network = own_landmark_session()
        cleaned = CleanScan()(scan).scan
        if cleaned.is_cloud:
            assert cleaned.normals is not None  # of cleaned scans
            spacing = cloud_normals(cleaned.points, 6).spacing
            look = disc_look(cleaned.points, cleaned.normals, 1.2 * spacing, cleaned.colors)
        else:
            look = surface_look(cleaned.points, cleaned.triangles, cleaned.colors)
        search = _Search(look=look, cloud=cleaned.is_cloud, draw=self.draw, network=network, size=network.size)
        frame, searched = search.face(scan.name)
        near = search.near(frame)
        seen = look_again(near, frame, _ALL, self.draw, network, network.size)
        seen = look_closer(near, frame, seen, _CLOSER, self.draw)
        nearest = closest_places(seen.landmarks, near.points, near.triangles)
        ended = nearest.distances >= _OFF * frame.side
        ends = search.ends(frame)
        if len(ends):  # the jaw alone: features lie inside of what scans show
            ended[:_JAW] |= cKDTree(ends).query(nearest.places[:_JAW])[0] < _END * frame.side
        left_out = {"views disagree": seen.spread >= _UNSURE, "the scan ends before them": ended}
        kept = ~np.any(list(left_out.values()), axis=0)
        eyes = seen.landmarks[36:42].mean(axis=0) - seen.landmarks[42:48].mean(axis=0)
        report = ScanLandmarksReport(
            found=int(kept.sum()),
            presence=seen.presence,
            spread=float(np.median(seen.spread)) * frame.side / float(np.linalg.norm(eyes)),
            searched=searched,
            warnings=tuple(f"{int(one.sum())} landmarks left out: {why}" for why, one in left_out.items() if one.any()),
        )
        places, sigmas = np.where(kept[:, None], nearest.places, np.nan), found_sigmas(colored=near.colors is not None)
        landmarks = ScanLandmarks(points=places, sigma_mm=sigmas)
        return FoundScanLandmarks(landmarks=landmarks, frame=frame, look=look, report=report)


@dataclass(frozen=True, kw_only=True)
class _Search:
    """The search for the face of one scan."""

    look: Look
    cloud: bool
    draw: Draw
    network: Network
    size: int  # pixels a side of the network's crops

    def face(self, name: str) -> tuple[FaceFrame, int]:
        """The surest face, along the axes of the file first, then all around; and how many views that took."""
        points = self.look.points
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        small = coarse_look(self.look, float((high - low).max()) / _CELLS)
        searched = 0
        for views, few, turns in ((axis_views(middle, radius), 1, 4), (sphere_views(middle, radius), 3, 6)):
            searched += len(views)
            if not is_worth_search(small, views[::few], turns, self.draw, self.network, self.size):
                continue
            judged: list[tuple[float, FaceFrame]] = []
            for _, frame in candidates(small, views, turns, self.draw, self.network, self.size, _MOST):
                # How sure a face is, and its frame as three views show it, and three along what those showed.
                once = self._moved(frame, _SURE / 2, np.inf)
                twice = None if once is None else self._moved(once[1], _SURE, _STEADY)
                judged += [twice] if twice is not None else []
                if twice is not None and twice[0] > _CERTAIN:
                    return twice[1], searched
            if judged:
                return max(judged, key=lambda one: one[0])[1], searched
        raise FitError(name, "no face found on it, expected one to be seen from outside: give landmarks in a file")

    def near(self, frame: FaceFrame) -> Look:
        """The surface around the face, small holes closed, no finer than pictures show."""
        part = self._part(frame)
        return part if len(part.points) < _FINE_CELLS**2 else coarse_look(part, frame.side / _FINE_CELLS)

    def ends(self, frame: FaceFrame) -> FloatArray:
        """(b, 3) points around the face at which the surface ends; none of a cloud."""
        if self.cloud:
            return np.zeros((0, 3))
        part = self._part(frame)
        return part.points[border_points(part.points, part.triangles)]

    def _part(self, frame: FaceFrame) -> Look:
        part = part_look(self.look, np.linalg.norm(self.look.points - frame.middle, axis=1) < _NEAR * frame.side)
        return part if self.cloud else filled_look(part, _HOLES * frame.side)

    def _moved(self, frame: FaceFrame, surer: float, steadier: float) -> tuple[float, FaceFrame] | None:
        """Score and frame by three views along `frame`; None where they are less sure or less steady than that."""
        near = self.near(frame)
        if not len(near.triangles):
            return None
        seen = look_again(near, frame, _FIRST, self.draw, self.network, self.size)
        spread, moved = float(np.median(seen.spread)), face_frame(seen.landmarks)
        if moved is None or seen.presence < surer or spread > steadier:
            return None
        return seen.presence - 5.0 * spread, moved


def found_sigmas(*, colored: bool) -> FloatArray:
    """(68,) mm: the jaw has no mark to find it by."""
    sigmas = np.where(np.arange(LANDMARK_COUNT) < _JAW, _JAW_MM, _FEATURES_MM)
    sigmas[_BROWS] = _SHOWN_MM if colored else _GUESSED_MM
    return sigmas

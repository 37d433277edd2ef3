"""The 68 landmarks of a face on any mesh: searched place by place, then seen from several sides, and from nearer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError
from facepipe.core.reports import Report, not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.coarse_surface import Look, coarse_look, filled_look, part_look, surface_look
from facepipe.geometry.pinhole import meeting_points
from facepipe.geometry.polygons import border_points
from facepipe.scanning.clean_scan import CleanScan
from facepipe.scanning.landmarks.search import (
    LEFT_EYE,
    MARGIN,
    MEETING,
    MOUTH,
    RIGHT_EYE,
    Draw,
    FaceFrame,
    Network,
    Seen,
    candidates,
    face_frame,
    look_again,
    other_faces,
)
from facepipe.scanning.landmarks.where import Place, Surface, looked_at, places, without_small
from facepipe.scans import LANDMARK_COUNT, Scan, ScanLandmarks, no_landmarks

_PIXELS = 400  # a side
_JAW = 17
_CELLS, _FINE_CELLS = 90, 200  # of a grid over the scan's width, and over a crop's side
_NEAR = 1.3  # of a crop's side: what pictures of the face show
_HOLES = 0.13  # of a crop's side: smaller ones, which would look like features, are closed
_MOST = 10  # candidates that are looked at again
_FIRST = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0))  # yaw and pitch, radians
_ALL = tuple((yaw, pitch) for pitch in (-0.1, 0.2) for yaw in (-0.5, -0.25, 0.0, 0.25, 0.5))
_CLOSER = tuple((yaw, 0.05) for yaw in (-0.5, -0.25, 0.0, 0.25, 0.5))
_SURE, _STEADY = 0.9, 0.02  # presence, and spread as a share of a side, of a face
_CERTAIN = 0.9  # score of a face beyond which no other is looked for
_PLAIN = 0.95  # and beyond which it is not looked at in clay and with other pieces, too
_AS_GOOD = 0.02  # of a score: colours that are this little worse than clay show more, as do all pieces than some
_DRAWN = 0.5  # score in clay below which a face that colours show is painted on
_KINDS = {"what": "the head's joint", "all": "all of it", "the end": "ends of a body", "a piece": "pieces"}
# Pictures drawn and maps made of them before the search ends, 40 s of processor time, and what a closer look counts.
_BUDGET, _CLOSE_LOOK = 1000, 8
_WRONG_SIZE = 2.5  # a face this many times as large or as small as usual has another unit than its file says
_UNSURE = 0.03  # of a side: spread of a landmark that is left out
_OFF = 0.03  # of a side: a landmark farther from the surface than this lies where the scan has ended
_END = 0.05  # of a side: the outline of a scan that ends nearer than this to the jaw's landmarks passes for the jaw
_ANOTHER = 0.7  # of a side: faces farther apart than this are two
_CARRIED = 0.05  # share of landmarks from which a connected piece carries the face
_EYES_MM = 62.5  # between the middles of the lids' landmarks, on ICT-FaceKit's mean
_BROWS = slice(17, 27)
_JAW_MM, _FEATURES_MM = 3.5, 0.8  # RMS along each coordinate, over simulated scans
# Of brows without colours, which are guessed, and with: off by 0.5, but nothing in the surface keeps them in place.
_GUESSED_MM, _SHOWN_MM = 1.5, 0.2


def look_closer(look: Look, frame: FaceFrame, seen: Seen, angles: Sequence[tuple[float, float]], draw: Draw) -> Seen:
    """Landmarks by views at `angles`; those of the jaw, which are no truer from near, stay as they were `seen`."""
    from facepipe.networks.files import dense_landmarks, own_dense_session

    views = [frame.view(yaw, pitch, _PIXELS, MARGIN) for yaw, pitch in angles]
    origins, directions, errors = [], [], []
    for view in views:
        picture = np.asarray(draw(look, view)[0], np.float32)
        found = dense_landmarks(own_dense_session(), picture, view.project(seen.landmarks)[0])
        if found is not None:
            origins.append(view.eye)
            directions.append(view.directions(found[0][_JAW:LANDMARK_COUNT]))
            errors.append(found[1][_JAW:LANDMARK_COUNT])
    if not origins:
        return seen
    # By 1 / error^2: a view that sees a landmark badly counts little.
    weights = 1.0 / np.stack(errors) ** 2
    places, distances = meeting_points(np.stack(origins), np.stack(directions), weights, MEETING * frame.side)
    landmarks, spread = np.array(seen.landmarks), np.array(seen.spread)
    landmarks[_JAW:], spread[_JAW:] = places, np.median(distances, axis=0) / frame.side
    return replace(seen, landmarks=landmarks, spread=spread)


@dataclass(frozen=True, kw_only=True)
class ScanLandmarksReport(Report):
    """How landmarks were found."""

    found: int
    presence: float  # 0..1: how much it looks like a face, over all views
    spread: float  # median distance of a landmark's rays from it, over landmarks, share of the distance of the eyes
    searched: int  # pictures in which the face was searched
    place: str = ""  # where it was found
    seen: str = "clay"  # or colours: how the surface was shown
    painted: bool = False  # colours alone show the face, the surface has none
    pieces: tuple[str, ...] = ()  # meshes, objects or groups that carry the face
    mm_per_unit: float = 0.0  # of the file; where it has no unit, as the face has a usual size
    unit_known: bool = True  # whether the file has a unit
    landmarks: Any = not_in_json()  # the `FoundScanLandmarks`, of which pictures are drawn


@dataclass(frozen=True, kw_only=True)
class FoundScanLandmarks:
    """Landmarks of a scan."""

    landmarks: ScanLandmarks
    frame: FaceFrame  # where the face is, and how it stands
    look: Look  # what was looked at: the mended scan, of a cloud discs
    carrier: BoolArray  # (n,) the scan's points on the connected pieces that carry the face
    report: ScanLandmarksReport


@dataclass(frozen=True, kw_only=True)
class FindScanLandmarks:
    """Finds a face's landmarks on a mesh or scan of any pose and unit, with colours or without, of a body or a head.

    Places that may hold a face are searched, the likeliest first (`facepipe.scanning.landmarks.where`), in colours and
    in clay: pictures of each, for crops that the landmark network takes for a face; those are looked at from
    several sides, and again by the network of many landmarks. Each landmark is where the rays through it meet, brought
    onto the surface. Those whose rays disagree, or meet off the surface, are left out.

    :param draw: draws a surface: ``(look, view) -> picture, depth``, like `facepipe.pictures.surface_view.draw_surface`
    :param component: name of the only mesh, object or group of the file that is looked at
    """

    draw: Draw
    component: str | None = None

    @one_thread()
    def __call__(self, scan: Scan) -> FoundScanLandmarks:
        """Search `scan`.

        :raises FitError: no face on it, or several
        :raises InputError: no surface, or no such component
        """
        from facepipe.networks.files import own_landmark_session

        surface = looked_at(scan, self.component)
        search = _Search(surface=surface, scan=scan, draw=self.draw, network=own_landmark_session())
        shown = search.face()
        others = search.others(shown)
        if others:
            middles = " and ".join(f"({x:.4g}, {y:.4g}, {z:.4g})" for x, y, z in (shown.frame.middle, *others))
            what = f"{1 + len(others)} faces, at {middles}: expected one, give landmarks in a file or --component"
            raise FitError(scan.name, what)
        return self._landmarks(scan, search, shown)

    def _landmarks(self, scan: Scan, search: _Search, shown: Shown) -> FoundScanLandmarks:
        from facepipe.geometry.closest_points import closest_places

        frame, surface = shown.frame, search.surface
        near = search.near(shown, fine=True)
        seen = look_again(near, frame, _ALL, self.draw, search.network)
        seen = look_closer(near, frame, seen, _CLOSER, self.draw)
        nearest = closest_places(seen.landmarks, near.points, near.triangles)
        left_out = {
            "views disagree": seen.spread >= _UNSURE,
            "the scan ends before them": search.ended(shown, nearest.places, nearest.distances),
        }
        kept = ~np.any(list(left_out.values()), axis=0)
        eyes = seen.landmarks[RIGHT_EYE].mean(axis=0) - seen.landmarks[LEFT_EYE].mean(axis=0)
        places, sigmas = np.where(kept[:, None], nearest.places, np.nan), found_sigmas(colored=near.colors is not None)
        carrier = search.carrier(shown, nearest.places[kept])
        used = carrier[scan.triangles].all(axis=1) if len(scan.hints.piece) else np.zeros(0, bool)
        own = scan.hints.mm_per_unit
        lines = [f"{int(one.sum())} landmarks left out: {why}" for why, one in left_out.items() if one.any()]
        if scan.hints.swapped:
            lines.append("mirrored: shapes that are called left move the right of this face, and the other way round")
        painted = near.colors is not None and search.is_painted(shown)
        if painted:
            lines.append("the face is painted: in clay none is seen there")
        by_size = _EYES_MM / float(np.linalg.norm(eyes))
        if own is not None and not 1 / _WRONG_SIZE < own / by_size < _WRONG_SIZE:
            large = f"the eyes are {own * float(np.linalg.norm(eyes)):.3g} mm apart in the file's unit"
            lines.append(f"{large}, expected about {_EYES_MM:g}: its unit may be wrong")
        report = ScanLandmarksReport(
            found=int(kept.sum()),
            presence=seen.presence,
            spread=float(np.median(seen.spread)) * frame.side / float(np.linalg.norm(eyes)),
            searched=search.counted.pictures,
            place=shown.place,
            seen="clay" if near.colors is None else "colours",
            painted=painted,
            pieces=tuple(scan.hints.pieces[one] for one in np.unique(scan.hints.piece[used]) if one >= 0),
            mm_per_unit=by_size if own is None else own,
            unit_known=own is not None,
            warnings=(*surface.warnings, *lines),
        )
        landmarks = ScanLandmarks(points=places, sigma_mm=sigmas)
        look = shown.look if shown.among.all() else part_look(shown.look, shown.among)
        return FoundScanLandmarks(landmarks=landmarks, frame=frame, look=look, carrier=carrier, report=report)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A face, and how the surface shows it."""

    score: float  # presence less five spreads
    frame: FaceFrame
    place: str
    look: Look  # in colours or clay
    among: BoolArray  # (n,) the points of the surface that are looked at


@dataclass
class _Counted:
    pictures: int = 0
    work: int = 0  # pictures and maps
    places: list[str] = field(default_factory=list)  # names of those that were searched


@dataclass(frozen=True, kw_only=True)
class _Search:
    """The search for the face of one scan."""

    surface: Surface
    scan: Scan
    draw: Draw
    network: Network
    counted: _Counted = field(default_factory=_Counted)

    @property
    def looks(self) -> list[Look]:
        """The surface in colours, if it has some, and in clay: colours may be masks, or too dark to see."""
        look = self.surface.look
        return [look] if look.colors is None else [look, replace(look, colors=None)]

    def face(self) -> Shown:
        """The surest face of the likeliest place that has one.

        :raises FitError: none
        """
        every = without_small(self.surface, np.ones(len(self.surface.component), bool))
        features = self.scan.hints.features
        if features is not None:
            marks = no_landmarks()
            for part, place in zip((LEFT_EYE, RIGHT_EYE, MOUTH), features, strict=True):
                marks[part] = place
            frame = face_frame(marks)
            found = [] if frame is None else self._judged([frame], "eyes and mouth by their shapes", every)
            if found:
                return self._best_shown(max(found, key=lambda one: one.score))
        for level in places(self.surface):
            judged: list[Shown] = []
            for place in level:
                for look in self.looks:
                    if self.counted.work + len(place.views) * (1 + place.turns) > _BUDGET:
                        break
                    judged += self._in_place(place, look)
                    if judged and judged[-1].score > _CERTAIN:
                        return self._best_shown(judged[-1])
                else:
                    self.counted.places.append(place.name)
            if judged:
                return self._best_shown(max(judged, key=lambda one: one.score))
        raise FitError(self.scan.name, self._refusal())

    def _refusal(self) -> str:
        shown, names = "colours and clay" if len(self.looks) > 1 else "clay", self.counted.places
        tried = [kind for start, kind in _KINDS.items() if any(name.startswith(start) for name in names)]
        seen = f"{self.counted.pictures} pictures in {shown} of {len(names)} places ({', '.join(tried)})"
        what = f"no face found on it in {seen}, expected one to be seen from outside"
        return f"{what}: give landmarks in a file"

    def _in_place(self, place: Place, look: Look) -> list[Shown]:
        """Faces of one place, the last one certain if any is."""
        part = part_look(look, place.points)
        if not len(part.triangles):
            return []
        small = coarse_look(part, float(np.ptp(part.points, axis=0).max()) / _CELLS)
        self.counted.pictures += len(place.views)
        self.counted.work += len(place.views) * (1 + place.turns)
        frames = [one for _, one in candidates(small, place.views, place.turns, self.draw, self.network, _MOST)]
        return self._judged(frames, place.name, place.among, look)

    def _judged(self, frames: list[FaceFrame], place: str, among: BoolArray, look: Look | None = None) -> list[Shown]:
        """What is a face of several, as three views show it, and three along what those showed; up to a certain one."""
        found: list[Shown] = []
        for frame in frames:
            for own in self.looks if look is None else (look,):
                if self.counted.work > _BUDGET:
                    return found
                maybe = Shown(score=0.0, frame=frame, place=place, look=own, among=among)
                once = self._moved(maybe, _SURE / 2, np.inf)
                twice = None if once is None else self._moved(once, _SURE, _STEADY)
                found += [] if twice is None else [twice]
                if twice is not None and twice.score > _CERTAIN:
                    return found
        return found

    def _best_shown(self, shown: Shown) -> Shown:
        """The face in colours or clay, with all pieces or those among which it was found: as it is surest."""
        every = without_small(self.surface, np.ones(len(shown.among), bool))
        if shown.score > _PLAIN and np.array_equal(every, shown.among):
            return shown
        sets = [every] if np.array_equal(every, shown.among) else [every, shown.among]
        ways = [replace(shown, look=look, among=among) for among in sets for look in self.looks]
        judged = [one for way in ways if (one := self._moved(way, _SURE, _STEADY)) is not None] or [shown]
        best = max(one.score for one in judged)
        return next(one for one in judged if one.score >= best - _AS_GOOD)

    def others(self, shown: Shown) -> list[FloatArray]:
        """Middles (3,) of other certain faces of a similar size."""
        every = without_small(self.surface, np.ones(len(shown.among), bool))
        part = part_look(shown.look, every)
        frames = other_faces(part, shown.frame, self.draw, self.network)
        found: list[FaceFrame] = [shown.frame]
        for frame in frames:
            for one in self._judged([frame], shown.place, every, shown.look):
                apart = min(np.linalg.norm(one.frame.middle - other.middle) / other.side for other in found)
                if one.score > _CERTAIN and apart > _ANOTHER:
                    found.append(one.frame)
        return [one.middle for one in found[1:]]

    def is_painted(self, shown: Shown) -> bool:
        """Whether the surface without colours shows no face there."""
        clay = self._moved(replace(shown, look=self.looks[-1]), 0.0, np.inf)
        return clay is None or clay.score < _DRAWN

    def near(self, shown: Shown, *, fine: bool = False) -> Look:
        """The surface around the face, small holes closed, no finer than pictures show.

        :param fine: by the scan's own points, where the surface has fewer
        """
        part = self._part(shown, fine=fine)
        return part if len(part.points) < _FINE_CELLS**2 else coarse_look(part, shown.frame.side / _FINE_CELLS)

    def ended(self, shown: Shown, places: FloatArray, distances: FloatArray) -> BoolArray:
        """(68,) landmarks where the scan has ended.

        :param places: (68, 3) of landmarks on the surface, and how far (68,) they were from it
        """
        from scipy.spatial import cKDTree

        ended: BoolArray = distances >= _OFF * shown.frame.side
        if self.surface.cloud:
            return ended
        part = self._part(shown)
        ends = part.points[border_points(len(part.points), part.triangles)]
        if len(ends):  # the jaw alone: features lie inside of what scans show
            ended[:_JAW] |= cKDTree(ends).query(places[:_JAW])[0] < _END * shown.frame.side
        return ended

    def carrier(self, shown: Shown, places: FloatArray) -> BoolArray:
        """(n,) points of the scan on connected pieces that have landmarks at `places` (k, 3)."""
        from scipy.spatial import cKDTree

        surface, scan = self.surface, self.scan
        at = np.flatnonzero(shown.among)
        nearest = at[cKDTree(surface.look.points[at]).query(places)[1]]
        counts = np.bincount(surface.component[nearest], minlength=int(surface.component.max()) + 1)
        carries = counts >= max(_CARRIED * len(places), 1)
        used = carries[surface.component]
        found = np.zeros(len(scan.points), bool)
        found[surface.source[used]] = True
        if surface.thinned:  # each point as the nearest one that stands for some
            found = used[cKDTree(surface.look.points).query(scan.points)[1]]
        return found

    def _part(self, shown: Shown, *, fine: bool = False) -> Look:
        frame, surface = shown.frame, self.surface
        if fine and surface.thinned and not surface.cloud:
            return filled_look(self._own_points(shown), _HOLES * frame.side)
        close = np.linalg.norm(surface.look.points - frame.middle, axis=1) < _NEAR * frame.side
        part = part_look(shown.look, close & shown.among)
        return part if surface.cloud or not len(part.triangles) else filled_look(part, _HOLES * frame.side)

    def _own_points(self, shown: Shown) -> Look:
        """What the scan itself has around the face, mended."""
        scan, frame = self.scan, shown.frame
        close = np.linalg.norm(scan.points - frame.middle, axis=1) < _NEAR * frame.side
        if not shown.among.all():
            close &= self.carrier(shown, frame.middle[None])
        triangles = scan.triangles[close[scan.triangles].all(axis=1)]
        used, corners = np.unique(triangles, return_inverse=True)
        part = Scan(
            name=scan.name,
            points=scan.points[used],
            triangles=corners.reshape(-1, 3).astype(np.int32),
            colors=None if shown.look.colors is None or scan.colors is None else scan.colors[used],
        )
        mended = CleanScan()(part).scan
        return surface_look(mended.points, mended.triangles, mended.colors)

    def _moved(self, shown: Shown, surer: float, steadier: float) -> Shown | None:
        """The face by three views along its frame; None where they are less sure or less steady than that."""
        near = self.near(shown)
        if not len(near.triangles):
            return None
        self.counted.work += _CLOSE_LOOK
        seen = look_again(near, shown.frame, _FIRST, self.draw, self.network)
        spread, moved = float(np.median(seen.spread)), face_frame(seen.landmarks)
        if moved is None or seen.presence < surer or spread > steadier:
            return None
        return replace(shown, score=seen.presence - 5.0 * spread, frame=moved)


def found_sigmas(*, colored: bool) -> FloatArray:
    """(68,) mm: the jaw has no mark to find it by."""
    sigmas = np.where(np.arange(LANDMARK_COUNT) < _JAW, _JAW_MM, _FEATURES_MM)
    sigmas[_BROWS] = _SHOWN_MM if colored else _GUESSED_MM
    return sigmas

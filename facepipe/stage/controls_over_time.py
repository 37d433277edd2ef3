"""Controls of any rig over time: numbers with time samples, as a DCC bakes them beside the points that they moved.

And these points: meshes of any stage that change from sample to sample, with or without a face, read and authored.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import Animation, Mesh
from facepipe.rig.neural_rig import Control
from facepipe.stage.files import check_suffix, check_units, new_stage, open_stage, save_layer
from facepipe.stage.prims import check_property_name, is_applied, prims_below
from facepipe.stage.read_mesh import is_left_handed, turned
from facepipe.stage.skeleton import read_animation
from facepipe.stage.sliders import read_sliders
from facepipe.stage.values import errors_below, floats, ints, matrix, reads_prim, to_ints, to_vec3f, usd_errors

MOST_SAMPLES = 100_000


def save_controls(
    path: str | os.PathLike[str],
    controls: Sequence[Control],
    values: FloatArray,
    codes: FloatArray,
    codes_per_second: float = 24.0,
) -> None:
    """Numbers ``facepipe:control:<name>`` of one prim, as `read_controls` reads them; atomically.

    :param values: (f, c)
    :param codes: (f,) ascending time codes; none for a pose, which is written without time
    :raises InputError: NaN, a name that USD can't hold, or a file that can't be written
    """
    check_suffix(Path(path))
    require_finite(np.asarray(values), str(path), "controls")
    stage = new_stage(0.001, "Y", codes_per_second)  # as a point cache: stages without a unit are in centimetres
    prim = UsdGeom.Scope.Define(stage, "/Controls").GetPrim()
    stage.SetDefaultPrim(prim)
    if len(codes):
        stage.SetStartTimeCode(float(codes[0]))
        stage.SetEndTimeCode(float(codes[-1]))
    author_controls(prim, path, controls, values, codes)
    save_layer(stage.GetRootLayer(), path)


def author_controls(
    prim: Usd.Prim, path: str | os.PathLike[str], controls: Sequence[Control], values: FloatArray, codes: FloatArray
) -> None:
    """Author numbers ``facepipe:control:<name>`` on a prim of the root layer.

    :param path: of the stage, for messages
    :param values: (f, c)
    :param codes: (f,) ascending time codes; none for a pose
    :raises InputError: a name that USD can't hold
    """
    layer = prim.GetStage().GetRootLayer()
    # by specs, not UsdAttribute.Set: 300 controls of 300 samples take 0.12 s instead of 0.41
    with Sdf.ChangeBlock():
        for control, column in zip(controls, np.asarray(values, np.float64).T, strict=True):
            check_property_name(path, "control", control.name)
            name = f"{tokens.CONTROL_PREFIX}{control.name}"
            own = layer.GetPrimAtPath(prim.GetPath())
            spec = Sdf.AttributeSpec(own, name, Sdf.ValueTypeNames.Double, declaresCustom=True)
            spec.customData = {"minimum": float(control.minimum), "maximum": float(control.maximum)}
            spec.default = float(control.default if len(codes) else column[0])
            for code, value in zip(codes.tolist(), column.tolist(), strict=False):
                layer.SetTimeSample(spec.path, code, value)


@dataclass(frozen=True, kw_only=True)
class ControlTrack:
    """One control over time. What is not authored of its range and default is None."""

    name: str
    where: str  # the trail to its attribute
    codes: FloatArray  # (k,) time codes, ascending; none for one that has a value without time only
    values: FloatArray  # (k,), or (1,)
    minimum: float | None = None
    maximum: float | None = None
    default: float | None = None

    def at(self, codes: FloatArray) -> FloatArray:
        """(T,) values at time codes, straight between samples and held beyond them, as USD does."""
        if not len(self.codes):
            return np.full(len(codes), self.values[0])
        return np.interp(codes, self.codes, self.values)

    def guessed(self, codes: FloatArray) -> npt.NDArray[np.bool_]:
        """(T,) time codes without a sample, between two that differ."""
        if not len(self.codes):
            return np.zeros(len(codes), dtype=bool)
        after = np.searchsorted(self.codes, codes)
        before = np.searchsorted(self.codes, codes, side="right") - 1
        inside = (before >= 0) & (after < len(self.codes)) & (before != after)
        last = len(self.codes) - 1
        return np.asarray(inside & (self.values[np.maximum(before, 0)] != self.values[np.minimum(after, last)]))


@dataclass(frozen=True, kw_only=True)
class Clip:
    """Controls that move together."""

    name: str
    tracks: tuple[ControlTrack, ...]
    moves_joints: bool = False  # it animates joints too, which no control moves


_NUMBER_TYPES = ("double", "float", "half", "int", "bool")
_USER_PREFIX = "userProperties:"  # where Maya and Blender put attributes of their own


def read_controls(path: str | os.PathLike[str], prims: Sequence[str] = ()) -> tuple[ControlTrack, ...]:
    """The controls of a stage: numbers ``facepipe:control:<name>`` of any prim; where there are none, the face's
    sliders with time samples, and the shapes that none of these drives, of the SkelAnimation.

    :param prims: paths of prims whose own numbers (custom attributes) are the controls instead
    :raises InputError: no such file or prim, no readable USD, values that are no numbers, NaN, or several
        SkelAnimations of which no skeleton plays one
    :raises SchemaError, TopologyError: damaged sliders or animations
    """
    with errors_below(str(Path(path))):
        stage = open_stage(path)
        tracks = [] if prims else list(_declared(stage))
        for named in prims:
            valid = Sdf.Path.IsValidPathString(named) and named.startswith("/")
            prim = stage.GetPrimAtPath(named) if valid else None
            if not prim:
                raise InputError(f"<{named}>", "no such prim, expected the path of one with controls")
            own = [one for one in prim.GetAuthoredAttributes() if one.IsCustom() and one.HasAuthoredValue()]
            numbers = [attribute for attribute in own if str(attribute.GetTypeName()) in _NUMBER_TYPES]
            if not numbers:
                raise InputError(f"<{named}>", "no custom attribute that is a number, expected controls")
            tracks += map(_track, numbers)
        if tracks:
            return tuple(tracks)
        sliders, driven = _sliders(stage)  # a shape that one drives moves by it, not by itself
        playing = _playing(stage)
        shapes = _clip(playing).tracks if playing else ()
        return (*sliders, *(track for track in shapes if track.name not in driven))


def read_clips(path: str | os.PathLike[str]) -> tuple[Clip, ...]:
    """All that moves controls on a stage: its declared controls, its face's sliders, each SkelAnimation with shapes.

    :raises InputError, SchemaError, TopologyError: as `read_controls`
    """
    with errors_below(str(Path(path))):
        stage = open_stage(path)
        clips = [Clip(name="controls", tracks=_declared(stage)), Clip(name="sliders", tracks=_sliders(stage)[0])]
        clips += [_clip(prim) for prim in _of_type(stage, UsdSkel.Animation)]
        return tuple(clip for clip in clips if clip.tracks)


def is_recorded(path: str | os.PathLike[str]) -> bool:
    """Whether a stage is to be learned from its samples: it has no face, or controls over time and points over time.

    Points may be those that a SkelAnimation moves, beside numbers ``facepipe:control:<name>``.

    :raises InputError: no such file, or no readable USD
    """
    with usd_errors(path):
        stage = open_stage(path)
        prims = list(prims_below(stage.GetPseudoRoot(), path))
    if not any(is_applied(prim, tokens.FACE_API) for prim in prims):
        return True
    sampled = [
        (prim, str(attribute.GetName()))
        for prim in prims
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetNumTimeSamples()
    ]
    declared = any(name.startswith(tokens.CONTROL_PREFIX) for _, name in sampled)
    if any(name == "points" and prim.IsA(UsdGeom.Mesh) for prim, name in sampled):
        return declared or any(
            (name.startswith(tokens.SLIDER_PREFIX) and name.endswith(":value"))
            or (name == "blendShapeWeights" and prim.IsA(UsdSkel.Animation))
            for prim, name in sampled
        )
    # a face's own sliders and shapes alone are no record: they are better learned from its own rig
    return declared and any(prim.IsA(UsdSkel.Animation) for prim, _ in sampled)


def _declared(stage: Usd.Stage) -> tuple[ControlTrack, ...]:
    namespace = tokens.CONTROL_PREFIX.rstrip(":")
    return tuple(
        _track(control)
        for prim in prims_below(stage.GetPseudoRoot(), "stage")
        for control in prim.GetAuthoredPropertiesInNamespace(namespace)
        if isinstance(control, Usd.Attribute) and control.HasAuthoredValue()
    )


def _track(attribute: Usd.Attribute) -> ControlTrack:
    where, kind = str(attribute.GetPath()), str(attribute.GetTypeName())
    if kind not in _NUMBER_TYPES:
        raise InputError(where, f"type {kind}, expected a number: one of {', '.join(_NUMBER_TYPES)}")
    codes = attribute.GetTimeSamples()
    read = [(code, attribute.Get(code)) for code in codes] or [(None, attribute.Get())]
    for code, value in read:
        if value is None or not np.isfinite(float(value)):
            when = "" if code is None else f" at time code {code:g}"
            raise InputError(where, f"{'no value' if value is None else 'NaN or infinity'}{when}, expected a number")
    # what the attribute declares: USD's limits, the hard ones first (USD 25.11 and later), or customData
    kinds = (attribute.GetHardLimits(), attribute.GetSoftLimits()) if hasattr(attribute, "GetHardLimits") else ()
    pairs = [(kind.GetMinimum(), kind.GetMaximum()) for kind in kinds]
    data = attribute.GetCustomData()
    pairs.append((data.get("minimum"), data.get("maximum")))
    low, high = (next((end for end in ends if end is not None), None) for ends in zip(*pairs, strict=True))
    for end in (low, high):
        if end is not None and not (isinstance(end, int | float) and np.isfinite(end)):
            raise InputError(str(attribute.GetPath()), f"limit {end}, expected a finite number")
    if low is not None and high is not None and not low < high:
        raise InputError(str(attribute.GetPath()), f"from {low:g} to {high:g}, expected a range")
    untimed = attribute.Get(Usd.TimeCode.Default())
    return ControlTrack(
        name=str(attribute.GetName()).removeprefix(tokens.CONTROL_PREFIX).removeprefix(_USER_PREFIX),
        where=where,
        codes=np.array(codes, dtype=np.float64),
        values=np.array([float(value) for _, value in read]),
        minimum=low,
        maximum=high,
        default=None if untimed is None or not np.isfinite(float(untimed)) else float(untimed),
    )


def _sliders(stage: Usd.Stage) -> tuple[tuple[ControlTrack, ...], set[str]]:
    """The sliders with time samples, and the shapes that these drive."""
    tracks, driven = [], set()
    for prim in prims_below(stage.GetPseudoRoot(), "stage"):
        if is_applied(prim, tokens.FACE_API):
            for slider in read_sliders(prim):
                attribute = prim.GetAttribute(f"{tokens.SLIDER_PREFIX}{slider.name}:value")
                if attribute.GetNumTimeSamples():
                    low, high, default = slider.minimum, slider.maximum, slider.default
                    track = replace(_track(attribute), name=slider.name, minimum=low, maximum=high, default=default)
                    tracks.append(track)
                    driven |= {slider.name, *(shape for shape, _ in slider.shapes)}
    return tuple(tracks), driven


def _of_type(stage: Usd.Stage, schema: type[Usd.SchemaBase]) -> list[Usd.Prim]:
    return [prim for prim in prims_below(stage.GetPseudoRoot(), "stage") if prim.IsA(schema)]


def _playing(stage: Usd.Stage) -> Usd.Prim | None:
    """The SkelAnimation with weights over time; of several, the one that a skeleton plays."""
    prims = [
        animation
        for animation in _of_type(stage, UsdSkel.Animation)
        if UsdSkel.Animation(animation).GetBlendShapeWeightsAttr().GetNumTimeSamples()
    ]
    if len(prims) < 2:
        return prims[0] if prims else None
    skeletons = _of_type(stage, UsdSkel.Skeleton)
    played = {UsdSkel.BindingAPI(skeleton).GetInheritedAnimationSource().GetPath() for skeleton in skeletons}
    chosen = [prim for prim in prims if prim.GetPath() in played]
    if len(chosen) != 1:
        some = ", ".join(str(prim.GetName()) for prim in prims[:6])
        raise InputError(
            some, f"{len(prims)} SkelAnimations with weights over time, expected one that a skeleton plays"
        )
    return chosen[0]


@reads_prim
def _clip(prim: Usd.Prim) -> Clip:
    """The shapes of a SkelAnimation as controls."""
    animation, where = read_animation(prim), str(prim.GetPath())
    codes = np.array(UsdSkel.Animation(prim).GetBlendShapeWeightsAttr().GetTimeSamples(), dtype=np.float64)
    if animation.shape_weights is None:
        return Clip(name=animation.name, tracks=(), moves_joints=bool(animation.joints))
    rate = prim.GetStage().GetTimeCodesPerSecond() or 24.0
    rows = np.asarray(animation.shape_weights, np.float64)
    if len(codes):  # samples of joints alone are none of the shapes
        assert animation.times is not None
        rows = rows[np.isin(animation.times, codes / rate)]
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        when = f" at time code {codes[bad[0]]:g}" if len(codes) else ""
        raise InputError(f"{where}.blendShapeWeights", f"NaN or infinity{when}, expected finite numbers")
    tracks = tuple(
        ControlTrack(name=shape, where=f"{where} -> {shape}", codes=codes, values=rows[:, number], default=0.0)
        for number, shape in enumerate(animation.shapes)
    )
    return Clip(name=animation.name, tracks=tracks, moves_joints=bool(animation.joints))


@dataclass(frozen=True, kw_only=True)
class CachedMesh:
    """One mesh over T samples."""

    mesh: Mesh  # name and faces; points of the first sample
    points: FloatArray  # (T, n, 3) float32 mesh space
    worlds: FloatArray  # (T, 4, 4) mesh space -> world
    untimed: FloatArray | None  # (n, 3) float32 points authored without time, mesh space
    untimed_world: FloatArray  # (4, 4) mesh space -> world without time
    authored: npt.NDArray[np.bool_]  # (T,) samples that hold points of this mesh; USD makes the others from these

    @property
    def guessed(self) -> npt.NDArray[np.bool_]:
        """(T,) samples that are between two different ones, so that nobody knows where the points were."""
        authored, numbers = np.flatnonzero(self.authored), np.arange(len(self.points))
        if not len(authored):
            return np.zeros(len(numbers), dtype=bool)
        before, after = np.searchsorted(authored, numbers, side="right") - 1, np.searchsorted(authored, numbers)
        inside = (before >= 0) & (after < len(authored)) & (before != after)
        return np.array(
            [
                here and not np.array_equal(self.points[authored[left]], self.points[authored[right]])
                for here, left, right in zip(inside, before, after, strict=True)
            ]
        )


@dataclass(frozen=True, kw_only=True)
class PointCache:
    """All meshes of a stage."""

    meshes: tuple[CachedMesh, ...]
    codes: npt.NDArray[np.float64]  # (T,) time codes; none where nothing moves, T = 1
    moving: npt.NDArray[np.bool_]  # (T,) samples at which points or the place of some mesh are authored
    codes_per_second: float
    meters_per_unit: float
    up_axis: str
    has_face: bool  # the stage has a face, whose skeleton may move the points further

    @property
    def times(self) -> npt.NDArray[np.float64] | None:
        """(T,) seconds; None: nothing moves, T = 1."""
        return self.codes / self.codes_per_second if len(self.codes) else None


def read_point_cache(path: str | os.PathLike[str], also: Collection[float] = ()) -> PointCache:
    """The meshes of a USD file at all samples of their points and transforms; skins and blendshapes are left out.

    :param also: further time codes to read them at
    :raises InputError: no such file, no readable USD, too many samples, or NaN
    :raises SchemaError: units that are no length
    :raises TopologyError: a mesh whose number of points or faces change, or whose faces don't fit its points
    """
    with errors_below(str(Path(path))):
        stage = open_stage(path)
        check_units(Path(path), stage)
        prims = [prim for prim in _prims(stage) if prim.IsA(UsdGeom.Mesh)]
        names = [str(prim.GetName()) for prim in prims]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(twice, "is the name of more than one mesh, expected different names")
        # time codes at which points or the place of a mesh are authored, apart from `also`: at codes of the controls
        # alone USD interpolates points, which nobody recorded
        own: set[float] = set()
        for prim in prims:
            own |= set(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples())
            place = prim
            while place and not place.IsPseudoRoot():
                own |= set(UsdGeom.Xformable(place).GetTimeSamples() if place.IsA(UsdGeom.Xformable) else ())
                place = place.GetParent()
        codes = sorted(own | set(also))
        if len(codes) > MOST_SAMPLES:
            raise InputError("time samples", f"{len(codes)}, expected at most {MOST_SAMPLES}")
        times = [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]
        return PointCache(
            meshes=tuple(_cached(prim, times) for prim in prims),
            codes=np.array(codes, dtype=np.float64),
            moving=np.array([code in own for code in codes] or [False]),
            codes_per_second=stage.GetTimeCodesPerSecond() or 24.0,
            meters_per_unit=float(UsdGeom.GetStageMetersPerUnit(stage)),
            up_axis=str(UsdGeom.GetStageUpAxis(stage)),
            has_face=any(is_applied(prim, tokens.FACE_API) for prim in _prims(stage)),
        )


def read_loose_animations(path: str | os.PathLike[str]) -> tuple[Animation, ...]:
    """The SkelAnimations of a USD file, whether it has a face or not.

    :raises InputError, TopologyError: no such file, no readable USD, NaN, a joint or shape twice, or arrays that don't
        fit each other
    """
    with errors_below(str(Path(path))):
        stage, animations = open_stage(path), []
        for prim in _prims(stage):
            if not prim.IsA(UsdSkel.Animation):
                continue
            animation, where = read_animation(prim), str(prim.GetPath())
            require_finite(animation, where)
            count = Counter((*animation.joints, *animation.shapes))
            twice = next((name for name, times in count.items() if times > 1), None)
            if twice is not None:
                raise InputError(where, f"'{twice}' twice, expected each joint and shape once")
            animations.append(animation)
        return tuple(animations)


def _prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    return prims_below(stage.GetPseudoRoot(), "stage")


@reads_prim
def _cached(prim: Usd.Prim, times: list[Usd.TimeCode]) -> CachedMesh:
    mesh, where = UsdGeom.Mesh(prim), str(prim.GetPath())
    samples = [floats(mesh.GetPointsAttr().Get(time), 3) for time in times]
    other = next((i for i, points in enumerate(samples) if len(points) != len(samples[0])), None)
    if other is not None:
        what = f"{len(samples[other])} points at a time sample, expected {len(samples[0])} as at the first"
        raise TopologyError(where, f"{what} (time code {times[other].GetValue():g})")
    faces = []
    for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()):
        given = [ints(attribute.Get(time)) for time in attribute.GetTimeSamples()] or [ints(attribute.Get())]
        # exporters may write samples of the faces too, all alike
        if any(not np.array_equal(sample, given[0]) for sample in given):
            raise TopologyError(where, f"{attribute.GetName()} change over time, expected the same faces throughout")
        faces.append(given[0])
    counts, indices = faces
    if counts.sum() != len(indices) or (indices.size and not 0 <= indices.min() <= indices.max() < len(samples[0])):
        raise TopologyError(where, f"faces that don't fit {len(samples[0])} points")
    points = np.stack(samples)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=(1, 2)))
    if bad.size:
        when = "" if times[0].IsDefault() else f" at time code {times[bad[0]].GetValue():g}"
        raise InputError(where, f"points hold NaN or infinity{when}, expected finite numbers")
    mesh_parts = Mesh(name=prim.GetName(), points=points[0], face_vertex_counts=counts, face_vertex_indices=indices)
    place, sampled = UsdGeom.Xformable(prim), set(mesh.GetPointsAttr().GetTimeSamples())
    return CachedMesh(
        mesh=turned(mesh_parts) if is_left_handed(mesh) else mesh_parts,
        points=points,
        worlds=np.stack([matrix(place.ComputeLocalToWorldTransform(time)) for time in times]),
        untimed=floats(mesh.GetPointsAttr().Get(), 3) if mesh.GetPointsAttr().Get() else None,
        untimed_world=matrix(place.ComputeLocalToWorldTransform(Usd.TimeCode.Default())),
        authored=np.array([time.GetValue() in sampled for time in times]),
    )


_MILLIMETRE = 0.001


def save_point_cache(
    path: str | os.PathLike[str],
    name: str,
    meshes: Sequence[Mesh],
    controls: Sequence[Control],
    values: FloatArray,
    points: FloatArray,
    rest: FloatArray,
    codes: FloatArray,
    codes_per_second: float,
) -> None:
    """Meshes whose points have time samples, below a prim with numbers ``facepipe:control:<name>``; atomically.

    :param name: of that prim
    :param meshes: names and faces
    :param values: (f, c)
    :param points: (f, n, 3) of all meshes one after another, millimetres, Y up
    :param rest: (n, 3) authored without time
    :param codes: (f,) ascending time codes
    :raises InputError: NaN, a name that USD can't hold, or a file that can't be written
    """
    check_suffix(Path(path))
    stage = new_stage(_MILLIMETRE, "Y", codes_per_second)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    author_controls(root, path, controls, values, codes)
    ends = np.cumsum([len(mesh.points) for mesh in meshes])
    for mesh, end in zip(meshes, ends, strict=True):
        own = slice(end - len(mesh.points), end)
        frames, still = points[:, own], rest[own]
        prim = UsdGeom.Mesh.Define(stage, root.GetPath().AppendChild(mesh.name))
        prim.CreateFaceVertexCountsAttr(to_ints(mesh.face_vertex_counts))
        prim.CreateFaceVertexIndicesAttr(to_ints(mesh.face_vertex_indices))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        attribute = prim.CreatePointsAttr(to_vec3f(still))
        bounds = np.stack([frames.min(axis=1), frames.max(axis=1)], axis=1)
        # an extent without samples would hide what moves out of it, where a viewer culls by it
        extent = prim.CreateExtentAttr(to_vec3f(np.stack([still.min(axis=0), still.max(axis=0)])))
        for code, frame, box in zip(codes.tolist(), frames, bounds, strict=True):
            attribute.Set(to_vec3f(frame), code)
            extent.Set(to_vec3f(box), code)
    save_layer(stage.GetRootLayer(), path)

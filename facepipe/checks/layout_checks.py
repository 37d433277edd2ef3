"""Checks of the stage as a whole: units, where the face is, what is bound to what, values that can be read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.checks.views import FaceView, Problem, array, at, length, numbers, some, value, words
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError
from facepipe.parts import FaceParts
from facepipe.rig import implausible
from facepipe.stage import Face
from facepipe.stage.api_schemas import authored_skel_properties
from facepipe.stage.assets import read_image
from facepipe.stage.guard import UNREADABLE, reason
from facepipe.stage.photos import LIGHT_ROWS, MOST_PIXELS, is_photo, key_fault, read_key_lamp
from facepipe.stage.prims import exact_name

_STRETCHED = 1e-4  # of a pixel's width


def photo_cameras(face: FaceView) -> Iterator[Problem]:
    """The camera of a photo is a perspective one with a clipping range, its apertures those of square pixels."""
    for prim in _photos(face):
        camera = UsdGeom.Camera(prim)
        authored = value(prim.GetAttribute(tokens.PHOTO_SIZE))
        size = array(authored)
        if size is None or len(size) != 2 or not ((size >= 1) & (size <= MOST_PIXELS)).all():
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_SIZE}", f"{authored}, expected 1 to {MOST_PIXELS} pixels each")
            continue
        across, up = _number(camera.GetHorizontalApertureAttr()), _number(camera.GetVerticalApertureAttr())
        attribute = camera.GetClippingRangeAttr()
        found = array(value(attribute))
        near, far = (float(found[0]), float(found[1])) if found is not None and len(found) == 2 else (0.0, 0.0)
        if value(camera.GetProjectionAttr()) != UsdGeom.Tokens.perspective:
            yield at(prim, f"projection {value(camera.GetProjectionAttr())}, expected perspective")
        elif not (across > 0 and up > 0 and _number(camera.GetFocalLengthAttr()) > 0):
            yield at(prim, "no focal length or aperture, expected all above 0")
        elif not 0 < near < far:
            yield at(prim, f"clippingRange {near:g} to {far:g}, expected 0 < near < far")
        elif not abs(up / size[1] * size[0] / across - 1) < _STRETCHED:
            yield at(prim, f"apertures {across:g} x {up:g} of {size[0]:g} x {size[1]:g} pixels, expected square pixels")


def photo_light(face: FaceView) -> Iterator[Problem]:
    """A photo has the light of nine spherical harmonics, and a tint of 0 or more for each material that it names."""
    for prim in _photos(face):
        light = numbers(prim.GetAttribute(tokens.PHOTO_LIGHT), 3)
        if length(light) != LIGHT_ROWS:
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_LIGHT}", f"{length(light)} rows, expected {LIGHT_ROWS}")
        tints = numbers(prim.GetAttribute(tokens.PHOTO_TINTS), 3)
        materials = words(prim.GetAttribute(tokens.PHOTO_TINTED_MATERIALS))
        if length(tints) != len(materials):
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_TINTS}", f"{length(tints)} tints, expected {len(materials)}")
        elif tints is not None and (tints < 0).any():
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_TINTS}", "below 0, expected factors of 0 or more")


def photo_key(face: FaceView) -> Iterator[Problem]:
    """The key light of a photo has a direction, light of 0 or more, and a shine whose exponent is above 0."""
    for prim in _photos(face):
        try:
            key = read_key_lamp(prim)
        except (*UNREADABLE, RuntimeError):
            yield at(prim, "key light that can't be read, expected vectors and numbers as FacepipePhotoAPI says")
            continue
        if key is None or not np.isfinite([*key.direction, *key.color, key.shine, key.exponent]).all():
            continue  # the check of finite numbers reports it
        fault = key_fault(key)
        if fault:
            yield at(prim, fault)


def photo_poses(face: FaceView) -> Iterator[Problem]:
    """The pose that a photo names is an animation of the face."""
    known = {exact_name(animation.GetPrim()) for animation in face.animations}
    for prim in _photos(face):
        name = str(value(prim.GetAttribute(tokens.PHOTO_ANIMATION)) or "")
        if name and name not in known:
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_ANIMATION}", f"'{name}' is no animation of the face")


def _photos(face: FaceView) -> Iterator[Usd.Prim]:
    return (prim for prim in face.of_type(UsdGeom.Camera) if is_photo(prim))


def _number(attribute: Usd.Attribute) -> float:
    found = array([value(attribute)])
    return float(found[0]) if found is not None and len(found) else 0.0


def composition(face: FaceView) -> Iterator[Problem]:
    """References, sublayers and payloads compose."""
    for error in face.stage.GetCompositionErrors():
        yield at("/", str(error))


def stage_units(face: FaceView) -> Iterator[Problem]:
    """metersPerUnit and upAxis are authored, metersPerUnit above 0."""
    if not UsdGeom.StageHasAuthoredMetersPerUnit(face.stage):
        yield at("/", "metersPerUnit not authored, expected the metres of one stage unit")
    else:
        unit = float(UsdGeom.GetStageMetersPerUnit(face.stage))
        if not (np.isfinite(unit) and unit > 0):
            yield at("/", f"metersPerUnit {unit:g}, expected a finite number above 0")
    if not face.stage.GetRootLayer().pseudoRoot.HasInfo(UsdGeom.Tokens.upAxis):
        yield at("/", "upAxis not authored, expected Y or Z")
    elif str(UsdGeom.GetStageUpAxis(face.stage)) not in ("Y", "Z"):
        yield at("/", f"upAxis '{UsdGeom.GetStageUpAxis(face.stage)}', expected Y or Z")


def has_mesh(face: FaceView) -> Iterator[Problem]:
    """A face has at least one mesh."""
    if face.prim is not None and not face.meshes:
        yield at(face.prim, "no Mesh below it, expected at least one")


def plausible(face: FaceView) -> Iterator[Problem]:
    """The face is as large as a head and, by its landmarks, stands upright and looks forward."""
    if face.prim is None:
        return
    try:
        whole = Face(face.stage, face.prim)
        up: Literal["Y", "Z"] = "Z" if whole.up_axis == "Z" else "Y"
        unit = whole.meters_per_unit
        lines = implausible(FaceParts(meshes=whole.meshes, skeleton=whole.skeleton, meters_per_unit=unit, up_axis=up))
    except FacepipeError:
        return  # other checks say what is wrong with it
    for line in lines:
        yield at(face.prim, line)


def textures(face: FaceView) -> Iterator[Problem]:
    """Every texture that a UsdUVTexture names is there and begins as an image does."""
    images: set[str] = set()
    for prim in face.of_type(UsdShade.Shader):
        given = prim.GetAttribute("inputs:file").Get() if prim.GetAttribute("inputs:file") else None
        if not isinstance(given, Sdf.AssetPath) or not given.path:
            continue
        if not given.resolvedPath:
            yield at(prim, f"texture @{given.path}@ can't be found")
            continue
        try:
            if given.resolvedPath not in images and read_image(given) is None:
                yield at(prim, f"@{given.path}@ is no image")
            images.add(given.resolvedPath)
        except InputError as error:
            yield at(prim, error.what)


def face_prim(face: FaceView) -> Iterator[Problem]:
    """The stage has a face: a prim with FacepipeFaceAPI."""
    if face.prim is None:
        yield at("/", "no prim with FacepipeFaceAPI; `facepipe import usd` makes a face of other UsdSkel files")


def default_prim(face: FaceView) -> Iterator[Problem]:
    """The face is the default prim, so that a reference to the file brings it."""
    default = face.stage.GetDefaultPrim()
    if face.prim is not None and default != face.prim:
        found = f"<{default.GetPath()}>" if default else "missing"
        yield at(face.prim, f"defaultPrim is {found}, expected the face")


def skel_root(face: FaceView) -> Iterator[Problem]:
    """The face is a SkelRoot, and skeletons and bound meshes stand below one: UsdSkel deforms nothing elsewhere."""
    if face.prim is not None and not face.prim.IsA(UsdSkel.Root):
        yield at(face.prim, f"is of type '{face.prim.GetTypeName()}', expected SkelRoot")
    else:
        bound = [mesh.prim for mesh in face.meshes if mesh.is_skinned or mesh.shape_names or mesh.skeleton_path]
        for prim in [skeleton.prim for skeleton in face.skeletons] + bound:
            if not UsdSkel.Root.Find(prim):
                yield at(prim, "no SkelRoot above it, expected one")


def skeleton_count(face: FaceView) -> Iterator[Problem]:
    """One Skeleton below the face, always: UsdSkel ignores blendshapes where there is none."""
    if len(face.skeletons) != 1:
        named = f" ({some(skeleton.path for skeleton in face.skeletons)})" if face.skeletons else ""
        yield at(face.prim or "/", f"{len(face.skeletons)} Skeleton prims{named}, expected one")


def skel_binding_api(face: FaceView) -> Iterator[Problem]:
    """SkelBindingAPI is applied to the Skeleton and to every prim with skel properties; without it they do nothing."""
    for prim in face.prims:
        if prim.HasAPI(UsdSkel.BindingAPI):
            continue
        authored = authored_skel_properties(prim)
        if authored or (prim.IsA(UsdSkel.Skeleton) and face.prim is not None):
            having = f" but {some(authored)}" if authored else ""
            yield at(prim, f"SkelBindingAPI not applied{having}, expected it")


def skeleton_bound(face: FaceView) -> Iterator[Problem]:
    """Every mesh with influences or blendshapes is bound to a Skeleton that is there."""
    for mesh in face.meshes:
        if not (mesh.is_skinned or mesh.shape_names):
            continue
        path = mesh.skeleton_path
        prim = face.stage.GetPrimAtPath(path) if path and path.IsPrimPath() else None
        if path is None:
            yield at(mesh.prim, "skel:skeleton names no Skeleton, expected one on the mesh or above it")
        elif not prim or not prim.IsA(UsdSkel.Skeleton):
            yield at(mesh.prim, f"skel:skeleton names <{path}>, expected a Skeleton")


def readable_values(face: FaceView) -> Iterator[Problem]:
    """Every authored value can be read and is of its attribute's type."""
    for attribute in _attributes(face):
        try:
            time = Usd.TimeCode.EarliestTime() if attribute.ValueMightBeTimeVarying() else Usd.TimeCode.Default()
            authored = attribute.Get(time)
        except (*UNREADABLE, RuntimeError) as error:
            yield at(attribute, f"can't be read ({reason(error)[:200]})")
            continue
        kind = attribute.GetTypeName()
        expected = Tf.Type.FindByName(kind.cppTypeName) if authored is not None and kind else None
        if expected is not None and expected.pythonClass and not isinstance(authored, expected.pythonClass):
            yield at(attribute, f"value of type {type(authored).__name__}, expected {kind}")


def finite(face: FaceView) -> Iterator[Problem]:
    """No number is NaN or infinite, at any time."""
    for attribute in _attributes(face):
        kind = str(attribute.GetTypeName())
        numeric = not kind.startswith(("token", "string", "asset", "int", "uint", "bool", "path", "uchar"))
        for time in (Usd.TimeCode.Default(), *map(Usd.TimeCode, attribute.GetTimeSamples())) if numeric else ():
            try:
                values = array(attribute.Get(time))
            except (*UNREADABLE, RuntimeError):
                continue  # the check of readable values reports it
            if values is not None and not np.isfinite(values).all():
                wrong = int(np.count_nonzero(~np.isfinite(values)))
                when = "" if time.IsDefault() else f" at time {time.GetValue():g}"
                yield at(attribute, f"{wrong} of {values.size} numbers are NaN or infinite{when}, expected finite ones")
                break


def _attributes(face: FaceView) -> Iterator[Usd.Attribute]:
    for prim in face.prims:
        yield from (attribute for attribute in prim.GetAuthoredAttributes() if attribute.HasAuthoredValue())

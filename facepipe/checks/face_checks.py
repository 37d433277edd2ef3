"""Checks of the stage as a whole: units, where the face is, what is bound to what, values that can be read; then of the
photos, sliders and their learned network, the recipe, and the neural rig that the face links.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from typing import Literal

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.checks.views import FaceView, Problem, array, at, length, numbers, some, unlisted, value, words
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.reading import digest
from facepipe.parts import FaceParts
from facepipe.registry import neural_rigs
from facepipe.rig import CHANNELS, implausible
from facepipe.rig.sliders import curve_fault
from facepipe.stage import Face
from facepipe.stage.material_variants import read_variants
from facepipe.stage.materials import read_image
from facepipe.stage.photos import LIGHT_ROWS, MOST_PIXELS, is_photo, key_fault, read_key_lamp
from facepipe.stage.prims import authored_skel_properties, exact_name
from facepipe.stage.recipes import NeuralRigLink, read_neural_rig_link
from facepipe.stage.sliders import read_slider_network
from facepipe.stage.values import UNREADABLE, reason
from facepipe.verbs.whole_faces import Topology

_STRETCHED = 1e-4  # of a pixel's width


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


def material_variants(face: FaceView) -> Iterator[Problem]:
    """Variants of materials bind materials of the face, each in the same way wherever it is shown."""
    if face.prim is None:
        return
    names = {str(prim.GetPath()): str(prim.GetPath()) for prim in face.of_type(UsdShade.Material)}
    try:
        read_variants(face.prim, face.prim.GetName()).of_materials(face.prim.GetName(), names)
    except FacepipeError as error:
        yield at(face.prim, f"{str(error.where).rpartition(' -> ')[2]} {error.what}")


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


def slider_names(prim: Usd.Prim | None) -> list[str]:
    """The sliders on a face prim, sorted."""
    if prim is None:
        return []
    prefix = tokens.SLIDER_PREFIX
    found = prim.GetAuthoredPropertiesInNamespace(prefix.rstrip(":"))
    return sorted({str(one.GetName()).removeprefix(prefix).rpartition(":")[0] for one in found} - {""})


def person_pose(face: FaceView) -> Iterator[Problem]:
    """The pose that is the person is an animation of the face."""
    if face.prim is None:
        return
    name = str(value(face.prim.GetAttribute(tokens.PERSON)) or "")
    if name and name not in {exact_name(animation.GetPrim()) for animation in face.animations}:
        yield at(f"{face.prim.GetPath()}.{tokens.PERSON}", f"'{name}' is no animation of the face")


def slider_lists(face: FaceView) -> Iterator[Problem]:
    """Joints, channels and gains of a slider are parallel, and so are shapes and their gains."""
    for name in slider_names(face.prim):
        for lists in (("joints", "channels", "channelGains"), ("shapes", "shapeGains")):
            lengths = [_length(face.prim, name, one) for one in lists]
            if len(set(lengths)) > 1:
                found = ", ".join(f"{length} {one}" for one, length in zip(lists, lengths, strict=True))
                yield at(_path(face.prim, name), f"{found}, expected as many of each")


def slider_range(face: FaceView) -> Iterator[Problem]:
    """A slider's minimum is at most its default, and that at most its maximum."""
    for name in slider_names(face.prim):
        low, default, high = (_slider_number(face.prim, name, one) for one in ("minimum", "default", "maximum"))
        if not low <= default <= high:
            yield at(_path(face.prim, name), f"default {default:g}, expected {low:g} to {high:g}")


def slider_value(face: FaceView) -> Iterator[Problem]:
    """A slider's value is within its range; values beyond are clamped."""
    for name in slider_names(face.prim):
        if value(_slider_attribute(face.prim, name, "value")) is not None:
            own, low, high = (_slider_number(face.prim, name, one) for one in ("value", "minimum", "maximum"))
            if not low <= own <= high:
                yield at(_path(face.prim, name), f"value {own:g}, expected {low:g} to {high:g}")


def slider_curves(face: FaceView) -> Iterator[Problem]:
    """Curves of sliders have 2 knots or more, values that ascend and amounts that never turn back."""
    for name in slider_names(face.prim):
        fault = _curves_fault(face.prim, name)
        if fault:
            yield at(_path(face.prim, name), fault)


def _curves_fault(prim: Usd.Prim | None, name: str) -> str | None:
    fields = ("channelKnots", "shapeKnots", "knotValues", "knotAmounts")
    found = (array(value(_slider_attribute(prim, name, field))) for field in fields)
    channels, shapes, values, amounts = ([] if one is None else one.tolist() for one in found)
    for field, counts, beside in (("channelKnots", channels, "joints"), ("shapeKnots", shapes, "shapes")):
        if counts and len(counts) != _length(prim, name, beside):
            return f"{len(counts)} {field}, expected none or as many as {beside}"
    counts = [*channels, *shapes]
    if not all(count >= 0 for count in counts) or not sum(counts) == len(values) == len(amounts):
        have = f"{len(values)} knotValues and {len(amounts)} knotAmounts"
        return f"{have}, expected as many of each as channelKnots and shapeKnots say"
    knots = iter(zip(values, amounts, strict=True))
    return next(filter(None, (curve_fault(tuple(islice(knots, int(count)))) for count in counts if count)), None)


def slider_mirrors(face: FaceView) -> Iterator[Problem]:
    """The mirror of a slider is another slider, which names it as its own."""
    names = slider_names(face.prim)
    mirrors = {name: str(value(_slider_attribute(face.prim, name, "mirror")) or "") for name in names}
    for name, other in mirrors.items():
        if other and (other == name or mirrors.get(other) != name):
            if other == name:
                fault = "is the slider itself"
            elif other not in mirrors:
                fault = "is no slider"
            else:
                fault = f"has '{mirrors[other]}' as its mirror" if mirrors[other] else "has no mirror"
            where = f"{_path(face.prim, name)}:mirror"
            yield at(where, f"'{other}' {fault}, expected two sliders that name each other")


def slider_targets(face: FaceView) -> Iterator[Problem]:
    """Sliders drive joints, channels and blendshapes that the face has."""
    for name in slider_names(face.prim):
        for field, known in (("joints", set(face.joints)), ("channels", set(CHANNELS)), ("shapes", face.shape_names)):
            yield from unlisted(_path(face.prim, name), field, words(_slider_attribute(face.prim, name, field)), known)


def recipe_options(face: FaceView) -> Iterator[Problem]:
    """The options of the recipe are a JSON object."""
    attribute = face.prim.GetAttribute(tokens.RECIPE_OPTIONS) if face.prim else None
    text = value(attribute)
    if text is None:
        return
    try:
        parsed = json.loads(str(text))
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        yield at(attribute, "no JSON object, expected one")


def recipe_digests(face: FaceView) -> Iterator[Problem]:
    """The recipe has a digest per source."""
    if face.prim is None:
        return
    sources, digests = (len(words(face.prim.GetAttribute(n))) for n in (tokens.RECIPE_SOURCES, tokens.RECIPE_DIGESTS))
    if sources != digests:
        yield at(f"{face.prim.GetPath()}.{tokens.RECIPE_DIGESTS}", f"{digests} digests, expected {sources}")


def _slider_attribute(prim: Usd.Prim | None, slider: str, field: str) -> Usd.Attribute | None:
    return prim.GetAttribute(f"{tokens.SLIDER_PREFIX}{slider}:{field}") if prim else None


def _path(prim: Usd.Prim | None, slider: str) -> str:
    return f"{prim.GetPath() if prim else ''}.{tokens.SLIDER_PREFIX}{slider}"


def _length(prim: Usd.Prim | None, slider: str, field: str) -> int:
    found = value(_slider_attribute(prim, slider, field))
    return len(found) if hasattr(found, "__len__") else 0


def _slider_number(prim: Usd.Prim | None, slider: str, field: str) -> float:
    found = array([value(_slider_attribute(prim, slider, field))])
    if found is not None and len(found) and np.isfinite(found[0]):
        return float(found[0])
    return 1.0 if field == "maximum" else 0.0


def slider_network(face: FaceView) -> Iterator[Problem]:
    """The learned network of the sliders is whole, and takes and gives what the face has."""
    if face.prim is None:
        return
    where = f"{face.prim.GetPath()}.{tokens.NETWORK_LAYERS.rpartition(':')[0]}"
    try:
        network = read_slider_network(face.prim)
    except FacepipeError as error:
        yield at(error.where or where, error.what)
        return
    if network is None:
        return
    joints, channels = (tuple(channel[i] for channel in network.channels) for i in range(2))
    for field, names, known in (
        ("sliders", network.sliders, set(slider_names(face.prim))),
        ("joints", joints, set(face.joints)),
        ("channels", channels, set(CHANNELS)),
        ("shapes", network.shapes, face.shape_names),
    ):
        yield from unlisted(where, field, names, known)


def neural_rig_file(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is there, whole, and learned on the meshes that the link names."""
    link = _neural_rig_link(face)
    if link is None:
        return
    if link.path is None:
        where = _link_path(face, tokens.NEURAL_RIG_FILE)
        yield at(where, link.refusal or f"@{link.file}@ can't be found, expected a neural rig (.fpnr)")
        return
    try:
        rig = neural_rigs().load(link.path)
    except FacepipeError as error:
        yield at(_link_path(face, tokens.NEURAL_RIG_FILE), str(error))
        return
    if rig.topology != link.topology:
        yield at(_link_path(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the file, expected the same")


def neural_rig_digest(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is still the one that was put on it."""
    link = _neural_rig_link(face)
    if link is not None and link.path is not None and digest([link.path]) != link.digest:
        where = _link_path(face, tokens.NEURAL_RIG_DIGEST)
        yield at(where, f"@{link.file}@ has changed, expected the file of {link.digest[:19]}...")


def neural_rig_topology(face: FaceView) -> Iterator[Problem]:
    """The neural rig that a face links was learned on meshes of the face's names, point counts and faces."""
    link = _neural_rig_link(face)
    if link is None:
        return
    try:
        meshes = Face(face.stage, face.prim).meshes
    except FacepipeError:
        return  # other checks say what is wrong with them
    if Topology.of(FaceParts(meshes=meshes)).digest != link.topology:
        yield at(_link_path(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the meshes, expected a rig learned on them")


def _neural_rig_link(face: FaceView) -> NeuralRigLink | None:
    return None if face.prim is None else read_neural_rig_link(face.prim)


def _link_path(face: FaceView, name: str) -> str:
    return f"{face.prim.GetPath() if face.prim else ''}.{name}"

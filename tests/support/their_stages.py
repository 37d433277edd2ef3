"""USD stages as other programs write them, drawn by seed, and what a face that was read of one shows otherwise.

Of pxr the comparison takes values and `UsdGeom.XformCache`; skinning, shapes and texture coordinates are computed here.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel
from their_glbs import grid, pick, png, yes

from facepipe.parts import FaceParts, Mesh, TextureInput
from facepipe.rig.animation import at_times, sample_transforms, sample_weights
from facepipe.stage import Face

Array = np.ndarray[Any, np.dtype[Any]]
Rng = np.random.Generator
Differences = list[tuple[str, str]]
Names = Sdf.ValueTypeNames


def new_stage(rng: Rng, folder: Path) -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(folder / pick(rng, "face.usda", "face.usdc")))
    UsdGeom.SetStageUpAxis(stage, pick(rng, "Y", "Z"))
    UsdGeom.SetStageMetersPerUnit(stage, pick(rng, 1.0, 0.01))
    stage.SetTimeCodesPerSecond(pick(rng, 24.0, 24.0, 30.0, 60.0, 1.0))
    return stage


def patch(stage: Usd.Stage, rng: Rng, path: str) -> UsdGeom.Mesh:
    points, faces, uvs = grid(rng, int(rng.integers(3, 6)), int(rng.integers(3, 6)))
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, one)) for one in points + rng.uniform(-0.3, 0.3, 3)])
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Names.TexCoord2fArray, "vertex")
    primvar.Set([Gf.Vec2f(*map(float, one)) for one in uvs])
    return mesh


def codes_of(rng: Rng, count: int) -> list[float]:
    return sorted({float(one) for one in rng.integers(0, 40, count)} | ({0.0} if yes(rng) else set()))


def move(prim: Any, rng: Rng, *, still: bool = False, most: float = 170.0) -> None:
    """Ops of a prim in an order that tools use, some of them over time; without `still` one moves at least."""
    xform = UsdGeom.Xformable(prim)
    moving = [] if still else [int(rng.integers(4))]
    moving += [i for i in range(4) if not still and yes(rng, 0.3)]

    def give(op: Any, number: int, draw: Callable[[], Any]) -> None:
        if number not in moving:
            op.Set(draw())
            return
        for code in codes_of(rng, int(rng.integers(2, 6))):
            op.Set(draw(), code)

    if yes(rng, 0.12):
        give(xform.AddTransformOp(), moving[0] if moving else 9, lambda: matrix_of(rng))
        return
    if yes(rng, 0.8) or 0 in moving:
        give(xform.AddTranslateOp(), 0, lambda: Gf.Vec3d(*map(float, rng.normal(size=3) * 0.3)))
    pivot = yes(rng, 0.3)
    if pivot:
        op = xform.AddTranslateOp(opSuffix="pivot")
        op.Set(Gf.Vec3d(0.1, 0.2, -0.1))
    if yes(rng, 0.7) or 1 in moving:
        kind = pick(rng, "xyz", "y", "orient")
        if kind == "xyz":
            give(xform.AddRotateXYZOp(), 1, lambda: Gf.Vec3f(*map(float, rng.uniform(-most, most, 3))))
        elif kind == "y":
            give(xform.AddRotateYOp(), 1, lambda: float(rng.uniform(-400, 400)))
        else:
            give(
                xform.AddOrientOp(),
                1,
                lambda: Gf.Quatf(Gf.Rotation(Gf.Vec3d(*rng.normal(size=3)), float(rng.uniform(-most, most))).GetQuat()),
            )
    if yes(rng, 0.4) or 2 in moving:
        give(xform.AddScaleOp(), 2, lambda: Gf.Vec3f(float(rng.uniform(0.5, 1.5))))
    if pivot:
        xform.AddTranslateOp(opSuffix="pivot", isInverseOp=True)


def matrix_of(rng: Rng) -> Gf.Matrix4d:
    turn = Gf.Rotation(Gf.Vec3d(*rng.normal(size=3)), float(rng.uniform(-170, 170)))
    made = Gf.Matrix4d(1.0).SetRotate(turn) * float(rng.uniform(0.6, 1.4))
    made[3, 3] = 1.0
    made.SetTranslateOnly(Gf.Vec3d(*map(float, rng.normal(size=3) * 0.3)))
    return made


def skinned(stage: Usd.Stage, rng: Rng, root: str, *, shapes: bool = True, played: bool = True) -> UsdGeom.Mesh:
    """A skeleton of three joints, a mesh on them, and an animation, in a place of their own."""
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/Skel")
    joints = ["neck", "neck/head", "neck/head/jaw"]
    place = UsdGeom.XformCache().GetLocalToWorldTransform(skeleton.GetPrim())
    rest = [matrix_of(rng) for _ in joints]
    rest = [one.GetOrthonormalized() for one in rest]
    worlds = [rest[0] * place]
    worlds += [rest[1] * worlds[0]]
    worlds += [rest[2] * worlds[1]]
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateRestTransformsAttr(rest)
    skeleton.CreateBindTransformsAttr(worlds)
    mesh = patch(stage, rng, f"{root}/Skinned")
    count = len(mesh.GetPointsAttr().Get())
    api = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    order = np.argsort(rng.random((count, 3)), axis=1)[:, :2]
    shares = rng.random((count, 2)) + 0.1
    shares = shares / shares.sum(1, keepdims=True)
    api.CreateJointIndicesPrimvar(False, 2).Set(order.ravel().tolist())
    api.CreateJointWeightsPrimvar(False, 2).Set(shares.ravel().astype(np.float32).tolist())
    api.CreateGeomBindTransformAttr(matrix_of(rng) if yes(rng) else Gf.Matrix4d(1.0))
    api.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    names = ["jawOpen", "smile"] if shapes else []
    for name in names:
        shape = UsdSkel.BlendShape.Define(stage, f"{mesh.GetPath()}/{name}")
        which = np.flatnonzero(rng.random(count) < 0.6)
        shape.CreatePointIndicesAttr(which.tolist())
        shape.CreateOffsetsAttr([Gf.Vec3f(*map(float, rng.normal(size=3) * 0.03)) for _ in which])
    if names:
        api.CreateBlendShapesAttr(names)
        api.CreateBlendShapeTargetsRel().SetTargets([f"{mesh.GetPath()}/{name}" for name in names])
    if played:
        animation = UsdSkel.Animation.Define(stage, f"{root}/Anim")
        used = joints if yes(rng) else joints[1:]
        animation.CreateJointsAttr(used)
        animation.CreateBlendShapesAttr(names)
        for code in codes_of(rng, 4):
            turns = [Gf.Rotation(Gf.Vec3d(*rng.normal(size=3)), float(rng.uniform(-60, 60))).GetQuat() for _ in used]
            animation.CreateRotationsAttr().Set([Gf.Quatf(one) for one in turns], code)
            animation.CreateTranslationsAttr().Set(
                [Gf.Vec3f(*map(float, rng.normal(size=3) * 0.2)) for _ in used], code
            )
            if names:
                animation.CreateBlendShapeWeightsAttr().Set(rng.random(2).astype(np.float32).tolist(), code)
        animation.CreateScalesAttr().Set([Gf.Vec3h(1, 1, 1)] * len(used))
        UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    return mesh


def save(stage: Usd.Stage) -> Path:
    stage.GetRootLayer().Save()
    return Path(stage.GetRootLayer().realPath)


# ---- kinds


def moving_prims(rng: Rng, folder: Path) -> Path:
    """Prims that move, at any depth, some against the stack, beside a skinned mesh or without."""
    stage = new_stage(rng, folder)
    root = UsdSkel.Root.Define(stage, "/Face")
    stage.SetDefaultPrim(root.GetPrim())
    move(root, rng, still=yes(rng, 0.6))
    path = "/Face"
    for number in range(int(rng.integers(1, 4))):
        path = f"{path}/{pick(rng, 'Group', 'Head', 'Eye')}{number}"
        move(UsdGeom.Xform.Define(stage, path), rng, still=yes(rng, 0.5))
        if yes(rng, 0.7):
            mesh = patch(stage, rng, f"{path}/Mesh{number}")
            move(mesh, rng, still=yes(rng, 0.5))
            if yes(rng, 0.25):
                UsdGeom.Xformable(mesh).SetResetXformStack(True)
    move(patch(stage, rng, "/Face/Last"), rng)
    if yes(rng, 0.5):
        above = "/Face" if yes(rng) else "/Face/Body"
        if above != "/Face":
            move(UsdGeom.Xform.Define(stage, above), rng, still=yes(rng))
        skinned(stage, rng, above, played=yes(rng, 0.7))
    return save(stage)


def turntable(rng: Rng, folder: Path) -> Path:
    """Prims that turn by whole turns between two samples, as turntables and eyes of toys do."""
    stage = new_stage(rng, folder)
    root = UsdSkel.Root.Define(stage, "/Face")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = patch(stage, rng, "/Face/Head")
    turned = UsdGeom.Xformable(mesh if yes(rng) else root)
    op = pick(rng, turned.AddRotateYOp, turned.AddRotateZOp)()
    op.Set(0.0, 0.0)
    op.Set(float(pick(rng, 360.0, 720.0, 200.0, -360.0)), float(pick(rng, 24.0, 100.0)))
    if yes(rng):
        skinned(stage, rng, "/Face", played=yes(rng))
    return save(stage)


def point_samples(rng: Rng, folder: Path) -> Path:
    """Points over time, of several meshes at codes of their own, skinned and moved at once or alone."""
    stage = new_stage(rng, folder)
    root = UsdSkel.Root.Define(stage, "/Face")
    stage.SetDefaultPrim(root.GetPrim())
    meshes = [patch(stage, rng, f"/Face/Mesh{i}") for i in range(int(rng.integers(1, 3)))]
    meshes += [skinned(stage, rng, "/Face", shapes=yes(rng))] if yes(rng) else []
    for mesh in meshes:
        base = np.array(mesh.GetPointsAttr().Get())
        if yes(rng, 0.3):
            mesh.GetPointsAttr().Clear()
        for code in codes_of(rng, int(rng.integers(2, 6))):
            moved = base + rng.normal(size=base.shape) * 0.05
            mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, one)) for one in moved], code)
    if yes(rng, 0.4):
        move(meshes[0], rng)
    return save(stage)


def shader(stage: Usd.Stage, path: str, kind: str, **inputs: Any) -> UsdShade.Shader:
    made = UsdShade.Shader.Define(stage, path)
    made.CreateIdAttr(kind)
    for name, value in inputs.items():
        kinds = {
            float: Names.Float,
            str: Names.String,
            Gf.Vec2f: Names.Float2,
            Gf.Vec3f: Names.Color3f,
            Sdf.AssetPath: Names.Asset,
        }
        made.CreateInput(name, kinds[type(value)]).Set(value)
    return made


def textured(rng: Rng, folder: Path) -> tuple[Usd.Stage, UsdGeom.Mesh, UsdShade.Material]:
    stage = new_stage(rng, folder)
    root = UsdSkel.Root.Define(stage, "/Face")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = patch(stage, rng, "/Face/Head")
    other = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map2", Names.TexCoord2fArray, "faceVarying")
    corners = len(mesh.GetFaceVertexIndicesAttr().Get())
    other.Set([Gf.Vec2f(*map(float, one)) for one in rng.random((corners, 2))])
    material = UsdShade.Material.Define(stage, "/Face/Looks/Skin")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return stage, mesh, material


PLACED: dict[str, list[tuple[Array, float, Array]]] = {}


def transform2d(rng: Rng, folder: Path) -> Path:
    """Chains of UsdTransform2d before the textures of one material."""
    stage, _, material = textured(rng, folder)
    surface = shader(stage, "/Face/Looks/Skin/Surface", "UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Names.Token))
    for name, channel in (("diffuseColor", "rgb"), ("roughness", "g"), ("occlusion", "r"), ("normal", "rgb")):
        if name != "diffuseColor" and yes(rng):
            continue
        (folder / f"{name}.png").write_bytes(png(rng))
        own = shader(stage, f"/Face/Looks/Skin/{name}", "UsdUVTexture", file=Sdf.AssetPath(f"./{name}.png"))
        if name == "normal":
            own.CreateInput("scale", Names.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            own.CreateInput("bias", Names.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        kind = Names.Color3f if name == "diffuseColor" else Names.Normal3f if name == "normal" else Names.Float
        surface.CreateInput(name, kind).ConnectToSource(
            own.CreateOutput(channel, Names.Float3 if channel == "rgb" else Names.Float)
        )
        given = own.CreateInput("st", Names.Float2)
        for number in range(int(rng.integers(0, 3))):
            place = shader(stage, f"/Face/Looks/Skin/{name}Place{number}", "UsdTransform2d")
            if yes(rng, 0.7):
                place.CreateInput("scale", Names.Float2).Set(Gf.Vec2f(*map(float, rng.uniform(-2, 3, 2))))
            if yes(rng, 0.5):
                place.CreateInput("rotation", Names.Float).Set(float(rng.uniform(-180, 180)))
            if yes(rng, 0.7):
                place.CreateInput("translation", Names.Float2).Set(Gf.Vec2f(*map(float, rng.uniform(-1, 1, 2))))
            given.ConnectToSource(place.CreateOutput("result", Names.Float2))
            given = place.CreateInput("in", Names.Float2)
        reader = shader(
            stage, f"/Face/Looks/Skin/{name}Reader", "UsdPrimvarReader_float2", varname=pick(rng, "st", "st", "map2")
        )
        given.ConnectToSource(reader.CreateOutput("result", Names.Float2))
    return save(stage)


def materialx(rng: Rng, folder: Path) -> Path:
    """Surfaces of MaterialX with values or images, some of them placed."""
    stage, _, material = textured(rng, folder)
    kind = pick(
        rng, "ND_standard_surface_surfaceshader", "ND_open_pbr_surface_surfaceshader", "ND_gltf_pbr_surfaceshader"
    )
    rough = "roughness" if "gltf" in kind else "specular_roughness"
    surface = shader(stage, "/Face/Looks/Skin/Surface", kind, **{rough: float(rng.random())})
    if yes(rng):
        surface.CreateInput(
            {"N": "metalness", "o": "base_metalness", "g": "metallic"}[kind[3] if kind[3] in "og" else "N"], Names.Float
        ).Set(float(rng.random()))
    material.CreateSurfaceOutput("mtlx").ConnectToSource(surface.CreateOutput("out", Names.Token))
    color = surface.CreateInput("base_color", Names.Color3f)
    if yes(rng, 0.3):
        color.Set(Gf.Vec3f(*map(float, rng.random(3))))
        return save(stage)
    (folder / "skin.png").write_bytes(png(rng))
    image = shader(stage, "/Face/Looks/Skin/Image", "ND_image_color3", file=Sdf.AssetPath("./skin.png"))
    color.ConnectToSource(image.CreateOutput("out", Names.Color3f))
    if yes(rng, 0.8):
        coordinate = image.CreateInput("texcoord", Names.Float2)
        if yes(rng):
            values: dict[str, Any] = {"scale": Gf.Vec2f(*map(float, rng.uniform(0.3, 3, 2)))} if yes(rng, 0.7) else {}
            values |= {"offset": Gf.Vec2f(*map(float, rng.uniform(-1, 1, 2)))} if yes(rng, 0.7) else {}
            values |= {"rotate": float(rng.uniform(-180, 180))} if yes(rng, 0.4) else {}
            place = shader(stage, "/Face/Looks/Skin/Place", "ND_place2d_vector2", **values)
            coordinate.ConnectToSource(place.CreateOutput("out", Names.Float2))
            coordinate = place.CreateInput("texcoord", Names.Float2)
        name = pick(rng, "st", "map2")
        reader = shader(stage, "/Face/Looks/Skin/Reader", "ND_geompropvalue_vector2", geomprop=name)
        coordinate.ConnectToSource(reader.CreateOutput("out", Names.Float2))
    return save(stage)


KINDS: dict[str, Callable[[Rng, Path], Path]] = {
    "moving prims": moving_prims,
    "turntables": turntable,
    "points over time": point_samples,
    "UsdTransform2d": transform2d,
    "MaterialX": materialx,
}


# ---- comparing


def world_points(stage: Usd.Stage, prim: Usd.Prim, code: float) -> Array:
    """(n, 3) points of a mesh in the world at a code: shapes, then linear blends of its joints, then its place."""
    cache = UsdGeom.XformCache(Usd.TimeCode(code))
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code), float)
    api = UsdSkel.BindingAPI(prim)
    targets = api.GetSkeletonRel().GetTargets()
    if not targets:
        world = np.array(cache.GetLocalToWorldTransform(prim)).T
        return np.asarray(points @ world[:3, :3].T + world[:3, 3])
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath(targets[0]))
    sources = UsdSkel.BindingAPI(skeleton.GetPrim()).GetAnimationSourceRel().GetTargets()
    animation = UsdSkel.Animation(stage.GetPrimAtPath(sources[0])) if sources else None
    joints = list(skeleton.GetJointsAttr().Get())
    local = {
        joint: np.array(rest).T for joint, rest in zip(joints, skeleton.GetRestTransformsAttr().Get(), strict=True)
    }
    if animation:
        moved = zip(
            animation.GetJointsAttr().Get(),
            animation.GetTranslationsAttr().Get(code),
            animation.GetRotationsAttr().Get(code),
            strict=True,
        )
        for joint, translation, rotation in moved:
            matrix = np.eye(4)
            matrix[:3, :3] = np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(rotation).GetNormalized()))).T
            matrix[:3, 3] = translation
            local[joint] = matrix
        weights = dict(
            zip(
                animation.GetBlendShapesAttr().Get() or [],
                animation.GetBlendShapeWeightsAttr().Get(code) or [],
                strict=False,
            )
        )
        paths = api.GetBlendShapeTargetsRel().GetTargets()
        for name, path in zip(api.GetBlendShapesAttr().Get() or [], paths, strict=False):
            shape = UsdSkel.BlendShape(stage.GetPrimAtPath(path))
            which = list(shape.GetPointIndicesAttr().Get())
            points[which] += weights.get(name, 0.0) * np.array(shape.GetOffsetsAttr().Get(), float).reshape(-1, 3)
    worlds: dict[str, Array] = {}
    for joint in joints:
        above = joint.rpartition("/")[0]
        worlds[joint] = (worlds[above] if above else np.eye(4)) @ local[joint]
    binds = [np.array(one).T for one in skeleton.GetBindTransformsAttr().Get()]
    matrices = np.stack([worlds[joint] @ np.linalg.inv(bind) for joint, bind in zip(joints, binds, strict=True)])
    shares = np.array(api.GetJointWeightsPrimvar().Get(), float).reshape(len(points), -1)
    which = np.array(api.GetJointIndicesPrimvar().Get()).reshape(len(points), -1)
    blended = np.einsum("nk,nkij->nij", shares, matrices[which])
    geom = np.array(api.GetGeomBindTransformAttr().Get()).T
    points = points @ geom[:3, :3].T + geom[:3, 3]
    points = np.einsum("nij,nj->ni", blended[:, :3, :3], points) + blended[:, :3, 3]
    place = np.array(cache.GetLocalToWorldTransform(skeleton.GetPrim())).T
    return np.asarray(points @ place[:3, :3].T + place[:3, 3])


def codes_in(stage: Usd.Stage) -> Array:
    """All codes at which an attribute has a sample."""
    return np.array(
        sorted({code for prim in stage.Traverse() for one in prim.GetAttributes() for code in one.GetTimeSamples()})
    )


def differences(path: Path, parts: FaceParts) -> Differences:
    """(subject, figure) of each thing that a face has otherwise than its stage."""
    stage = Usd.Stage.Open(str(path))
    found: Differences = []
    if parts.meters_per_unit != UsdGeom.GetStageMetersPerUnit(stage) or parts.up_axis != UsdGeom.GetStageUpAxis(stage):
        found.append(("units", f"{parts.meters_per_unit:g} m, {parts.up_axis} up"))
    prims = {str(prim.GetName()): prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    if {mesh.name for mesh in parts.meshes} != {*prims}:
        return [("meshes", f"{[mesh.name for mesh in parts.meshes]}, expected {sorted(prims)}")]
    face, codes, rate = Face.from_parts(parts), codes_in(stage), stage.GetTimeCodesPerSecond()
    clip = next((one for one in parts.animations if one.name == parts.played and one.times is not None), None)
    # at samples all must be right; between them USD is linear in each value, of which turns are no lines
    between = (
        np.concatenate([codes[:-1] + share * np.diff(codes) for share in (0.25, 0.5, 0.8)]) if len(codes) else codes
    )
    line = 6e-5 / parts.meters_per_unit  # where lines stand for turns
    for subject, times in (("animation", codes), ("between samples", between)):
        worst: dict[str, float] = {}
        moving = None if clip is None or not len(times) else at_times(parts.skeleton, clip, np.asarray(times) / rate)
        for index, code in enumerate(times):
            points = face.evaluate()
            if moving is not None:
                points = face.evaluate(
                    sample_weights(moving, index), joint_transforms=sample_transforms(parts.skeleton, moving, index)
                )
            split = face.split(points)
            for name, prim in prims.items():
                truth = world_points(stage, prim, float(code))
                off = float(np.abs(split[name] - truth).max())
                if not off < line + 1e-4 * max(1.0, float(np.abs(truth).max())):
                    worst[name] = max(worst.get(name, 0.0), off)
        found += [(subject, f"{name} off by {off:.3g} units") for name, off in worst.items()]
    for mesh in parts.meshes:
        found += _surfaces(stage, prims[mesh.name], mesh, parts, path.parent)
    return found


def _surfaces(stage: Usd.Stage, prim: Usd.Prim, own: Mesh, parts: FaceParts, folder: Path) -> Differences:
    targets = UsdShade.MaterialBindingAPI(prim).GetDirectBindingRel().GetTargets()
    if not targets:
        return []
    found: Differences = []
    material = next((one for one in parts.materials if one.name == own.material), None)
    if material is None:
        return [("materials", "the material is not there")]
    surface = stage.GetPrimAtPath(f"{targets[0]}/Surface")
    preview = UsdShade.Shader(surface).GetIdAttr().Get() == "UsdPreviewSurface"
    names = {"base_color": "diffuse_color", "diffuseColor": "diffuse_color", "specular_roughness": "roughness"}
    names |= {"metalness": "metallic", "base_metalness": "metallic"}
    for given in UsdShade.Shader(surface).GetInputs():
        used = getattr(material, names.get(given.GetBaseName(), given.GetBaseName()))
        if not given.HasConnectedSource():
            wanted = np.array(given.Get(), float)
            if isinstance(used, TextureInput) or np.abs(np.array(used) - wanted).max() > 1e-5:
                found.append(("colours", f"{given.GetBaseName()} {used}, expected {wanted}"))
            continue
        node = given.GetConnectedSource()[0]
        if not isinstance(used, TextureInput):
            found.append(("textures", f"{given.GetBaseName()} is not there"))
            continue
        image = UsdShade.Shader(node.GetPrim()).GetInput("file").Get().path
        mine, wanted = (
            np.asarray(Image.open(one).convert("RGB"), int) for one in (io.BytesIO(used.texture.data), folder / image)
        )
        if mine.shape != wanted.shape or (mine != wanted).any():
            found.append(("textures", f"other pixels of {given.GetBaseName()}"))
        expected = _placed(UsdShade.Shader(node.GetPrim()), prim, preview=preview)
        sets = {one.name: one for one in own.uv_sets}
        if used.uv_set not in sets:
            found.append(("uvs", f"no set {used.uv_set}"))
            continue
        uvs = sets[used.uv_set]
        values = np.asarray(uvs.values, float)[uvs.indices if uvs.indices is not None else own.face_vertex_indices]
        off = float(np.abs(values - expected).max())
        if off > 2e-5 * max(1.0, float(np.abs(expected).max())):
            found.append(("uvs", f"{given.GetBaseName()} off by {off:.3g}"))
    return found


def _placed(node: UsdShade.Shader, prim: Usd.Prim, *, preview: bool) -> Array:
    """(corners, 2) where a texture is read, v up: UsdTransform2d scales, turns counter-clockwise, moves.

    MaterialX's place2d (scale, rotate, translate order): ``rotate((uv - pivot) / scale) - offset + pivot``, its
    rotate2d turning counter-clockwise for positive degrees in the order of its nodegraph.
    """
    given = node.GetInput("st" if preview else "texcoord")
    chain = []
    while given and given.HasConnectedSource():
        node = UsdShade.Shader(given.GetConnectedSource()[0].GetPrim())
        if node.GetIdAttr().Get() in ("UsdTransform2d", "ND_place2d_vector2"):
            chain.append(node)
        given = node.GetInput("in") or node.GetInput("texcoord")
    reader = node.GetInput("varname") or node.GetInput("geomprop")
    name = str(reader.Get()) if reader else "st"
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
    uv = np.array(primvar.Get(), float)
    if primvar.GetInterpolation() != "faceVarying":
        uv = uv[list(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get())]

    def value(one: UsdShade.Shader, key: str, otherwise: Any) -> Any:
        own = one.GetInput(key)
        return otherwise if not own or own.Get() is None else own.Get()

    for one in reversed(chain):
        if preview:
            scale, angle, offset = (
                value(one, "scale", (1, 1)),
                value(one, "rotation", 0.0),
                value(one, "translation", (0, 0)),
            )
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            uv = (uv * np.array(scale)) @ np.array([[c, s], [-s, c]]) + np.array(offset)
        else:
            scale, angle, offset = value(one, "scale", (1, 1)), value(one, "rotate", 0.0), value(one, "offset", (0, 0))
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            scaled = uv / np.array(scale)
            # stdlib's mx_rotate_vector2: (c x - s y, s x + c y) with the angle negated
            uv = np.stack([c * scaled[:, 0] + s * scaled[:, 1], -s * scaled[:, 0] + c * scaled[:, 1]], 1) - np.array(
                offset
            )
    return uv

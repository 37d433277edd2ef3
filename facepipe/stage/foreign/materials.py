"""Materials that the meshes of a foreign stage use."""

from __future__ import annotations

from pxr import Sdf, Usd, UsdGeom, UsdShade

from facepipe.core.errors import InputError
from facepipe.parts import Material, TextureInput
from facepipe.stage.display_names import told_apart
from facepipe.stage.foreign.scene import Scene
from facepipe.stage.read_materials import read_material

_READ = {
    "diffuseColor",
    "emissiveColor",
    "metallic",
    "roughness",
    "opacity",
    "opacityThreshold",
    "occlusion",
    "normal",
    "ior",
    "clearcoat",
    "clearcoatRoughness",
    "useSpecularWorkflow",  # named apart
}


def bound_materials(scene: Scene, meshes: list[Usd.Prim]) -> tuple[dict[str, str], tuple[Material, ...]]:
    """Names by prim path, and the materials, of those bound to meshes or their faces that are UsdPreviewSurface."""
    bound: dict[str, Usd.Prim] = {}
    for mesh in meshes:
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(mesh))
        for prim in [mesh, *(subset.GetPrim() for subset in subsets)]:
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            if material:
                bound[str(material.GetPath())] = material.GetPrim()
    names = dict(zip(bound, told_apart([*bound.values()], [str(one.GetName()) for one in bound.values()]), strict=True))
    read = {path: _read(scene, prim, names[path]) for path, prim in bound.items()}
    materials = tuple(material for material in read.values() if material is not None)
    return {path: names[path] for path, material in read.items() if material is not None}, materials


def _refusal(material: Material | None) -> InputError | None:
    """Why an image of the material may not be copied."""
    values = vars(material).values() if material else ()
    images = (one.texture for one in values if isinstance(one, TextureInput))
    return next((one.refusal for one in images if one.refusal), None)


def _read(scene: Scene, prim: Usd.Prim, name: str) -> Material | None:
    """One material; a texture that can't be had is left out of it."""
    while True:
        try:
            material = read_material(prim, name)
            if refusal := _refusal(material):
                raise refusal
            break
        except InputError as error:
            attribute = scene.stage.GetAttributeAtPath(Sdf.Path(error.where))
            if not attribute or not attribute.HasAuthoredValue():
                raise
            scene.warn(f"{error}: left out")
            attribute.Block()
    if material is None:
        scene.warn("material without UsdPreviewSurface: left out", [prim])
        return None
    surface, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    lost = sorted({one.GetBaseName() for one in surface.GetInputs()} - _READ)
    if surface.GetInput("useSpecularWorkflow") and surface.GetInput("useSpecularWorkflow").Get():
        lost.append("the specular workflow")
    if any(UsdShade.Shader(one).GetShaderId() == "UsdTransform2d" for one in Usd.PrimRange(prim)):
        lost.append("texture transforms")
    if lost:
        scene.warn(f"{', '.join(lost)} of the material: left out", [prim])
    return material

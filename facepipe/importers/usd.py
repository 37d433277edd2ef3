"""Import of other tools' UsdSkel files: skeletons, skins, blendshapes, materials and animations of any layout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import SchemaError, TopologyError
from facepipe.core.names import unique_identifiers
from facepipe.declare import check_ranges
from facepipe.importers.options import UsdOptions
from facepipe.parts import Animation, FaceParts, Material, Mesh, Slider, SliderNetwork, Texture
from facepipe.rig.slider_network import kept as kept_outputs
from facepipe.rig.sliders import kept, with_mutual_mirrors
from facepipe.stage.recipes import Imported, import_recipe, with_units

Options = UsdOptions

_WEIGHT_SUM_TOLERANCE = 1e-5


def read(source: Path, options: Options) -> Imported:
    """The face on a UsdSkel stage, as it stands at its default time.

    :raises InputError: no readable USD, no meshes, or a choice of prim or Skeleton that has to be made
    :raises SchemaError: values that are not finite, or names that don't pair
    :raises TopologyError: counts and indices that don't fit each other, or a singular bind transform
    """
    from facepipe.stage.foreign import read_foreign

    check_ranges(options)
    parts, files, warnings = read_foreign(
        source, root=options.prim, skeleton=options.skeleton, variants=options.variant, strict=options.strict
    )
    meshes = tuple(_normalised(source, mesh, warnings) for mesh in parts.meshes)
    skeleton = parts.skeleton
    paths: dict[str, str] = {}
    siblings: dict[str, list[str]] = {}
    for joint in skeleton.joints:
        siblings.setdefault(joint.rpartition("/")[0], []).append(joint)
    identifiers = {
        joint: name
        for joints in siblings.values()
        for joint, name in zip(joints, unique_identifiers(one.rpartition("/")[2] for one in joints), strict=True)
    }
    for joint in skeleton.joints:
        above = joint.rpartition("/")[0]
        parent = paths.get(above) or "/".join(unique_identifiers([name])[0] for name in above.split("/") if name)
        paths[joint] = f"{parent}/{identifiers[joint]}" if parent else identifiers[joint]
    changed = [(old, new) for old, new in paths.items() if old != new]
    if changed:
        old, new = changed[0]
        warnings.append(f"{len(changed)} joint paths made identifiers, like '{new}' of '{old}'; the names are kept")
    skeleton, new_names = replace(skeleton, joints=tuple(paths.values())).called(skeleton.names), paths
    _check_transforms(source, parts)
    shapes = {shape.name for mesh in meshes for shape in mesh.blendshapes}
    found = (_kept(animation, new_names, shapes) for animation in parts.animations)
    animations = tuple(animation for animation in found if animation is not None)
    sliders = _kept_sliders(parts.sliders, new_names, shapes, warnings)
    parts = replace(
        parts,
        meshes=meshes,
        skeleton=skeleton,
        animations=animations,
        played=parts.played if any(animation.name == parts.played for animation in animations) else None,
        sliders=sliders,
        slider_network=_kept_network(parts.slider_network, sliders, new_names, shapes, warnings),
        materials=_distinct_textures(parts.materials),
        recipe=import_recipe("usd", {source: files}, options),
    )
    parts = with_units(parts, options.meters_per_unit, options.up_axis)
    return Imported(parts=parts, warnings=tuple(warnings))


def _normalised(source: Path, mesh: Mesh, warnings: list[str]) -> Mesh:
    """The mesh with weights that sum to 1 at every point."""
    if mesh.skin is None:
        return mesh
    weights: FloatArray = np.asarray(mesh.skin.joint_weights, dtype=np.float64)
    indices: IntArray = mesh.skin.joint_indices
    if not np.isfinite(weights).all():
        raise SchemaError(f"{source} -> {mesh.name}", "joint weights hold NaN or infinity, expected finite numbers")
    if (weights < 0).any():
        warnings.append(f"{mesh.name}: weights below 0 taken as 0")
        weights = np.maximum(weights, 0.0)
    sums = weights.sum(axis=1)
    lost = sums <= 0
    if lost.any():
        warnings.append(f"{mesh.name}: {int(lost.sum())} points without weight now follow the first joint")
        weights = np.where(lost[:, None], np.eye(1, weights.shape[1]), weights)
        indices = np.where(lost[:, None], 0, indices)
        sums = weights.sum(axis=1)
    wrong = np.abs(sums - 1) > _WEIGHT_SUM_TOLERANCE
    if wrong.any():
        found = f"{sums.min():.4g} to {sums.max():.4g}"
        warnings.append(f"{mesh.name}: weights of {int(wrong.sum())} points normalised, their sums were {found}")
    return replace(
        mesh,
        skin=replace(
            mesh.skin,
            joint_indices=indices.astype(np.int32),
            joint_weights=(weights / sums[:, None]).astype(np.float32),
        ),
    )


def _kept(animation: Animation, new_names: Mapping[str, str], shapes: set[str]) -> Animation | None:
    """The animation with only the joints and shapes that the face has; None where nothing is left."""
    joints = [i for i, joint in enumerate(animation.joints) if joint in new_names]
    weights = [i for i, shape in enumerate(animation.shapes) if shape in shapes]
    if not joints and not weights:
        return None

    def columns(values: FloatArray | None, which: list[int]) -> FloatArray | None:
        return values[:, which] if values is not None and which else None

    return replace(
        animation,
        joints=tuple(new_names[animation.joints[i]] for i in joints),
        translations=columns(animation.translations, joints),
        rotations=columns(animation.rotations, joints),
        scales=columns(animation.scales, joints),
        coefficients=columns(animation.coefficients, joints),
        shapes=tuple(animation.shapes[i] for i in weights),
        shape_weights=columns(animation.shape_weights, weights),
    )


def _kept_sliders(
    sliders: tuple[Slider, ...], new_names: Mapping[str, str], shapes: set[str], warnings: list[str]
) -> tuple[Slider, ...]:
    """The sliders with only the joints and shapes that the face has; those that move nothing are left out."""
    result = []
    for slider in sliders:
        rest = kept(slider, new_names.__contains__, shapes.__contains__)
        lost = len(slider.channels) + len(slider.shapes) - len(rest.channels) - len(rest.shapes)
        if lost and not rest.channels and not rest.shapes:
            warnings.append(f"slider {slider.name}: left out, the face has nothing that it moves")
            continue
        if lost:
            warnings.append(f"slider {slider.name}: {lost} of its channels and shapes left out, which the face lacks")
        channels = tuple((new_names[joint], channel, gain) for joint, channel, gain in rest.channels)
        result.append(replace(rest, channels=channels))
    return with_mutual_mirrors(result)


def _kept_network(
    network: SliderNetwork | None,
    sliders: tuple[Slider, ...],
    new_names: Mapping[str, str],
    shapes: set[str],
    warnings: list[str],
) -> SliderNetwork | None:
    """The learned network with only the joints and shapes that the face has; None where its sliders are not left."""
    if network is None:
        return None
    rest = kept_outputs(network, new_names.__contains__, shapes.__contains__)
    if rest is None or not {slider.name for slider in sliders}.issuperset(rest.sliders):
        warnings.append("slider network: left out, the face lacks its sliders or all that it adds to")
        return None
    lost = len(network.channels) + len(network.shapes) - len(rest.channels) - len(rest.shapes)
    if lost:
        warnings.append(f"slider network: {lost} of its channels and shapes left out, which the face lacks")
    return replace(rest, channels=tuple((new_names[joint], channel) for joint, channel in rest.channels))


def _check_transforms(source: Path, parts: FaceParts) -> None:
    """:raises TopologyError: a matrix that can't be inverted"""
    skeleton = parts.skeleton
    named = [
        (f"{skeleton.name} -> {joint}", matrix)
        for joint, matrix in zip(skeleton.joints, skeleton.bind_transforms, strict=True)
    ]
    named += [(skeleton.name, skeleton.transform)]
    named += [(mesh.name, mesh.skin.geom_bind_transform) for mesh in parts.meshes if mesh.skin]
    for name, matrix in named:
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix[:3, :3]) < 3:
            raise TopologyError(f"{source} -> {name}", "singular or non-finite matrix, expected an invertible one")
    for mesh in parts.meshes:
        if not np.isfinite(mesh.transform).all():
            raise SchemaError(f"{source} -> {mesh.name}", "transform with NaN or infinity, expected finite numbers")


def _distinct_textures(materials: Iterable[Material]) -> tuple[Material, ...]:
    """Different images that share a file name get names of their own."""
    names: dict[tuple[str, bytes], str] = {}

    def own_name(texture: Texture) -> str:
        key = (texture.name, texture.data)
        if key not in names:
            stem, dot, suffix = texture.name.rpartition(".")
            taken, number, candidate = set(names.values()), 2, texture.name
            while candidate in taken:
                candidate, number = f"{stem if dot else suffix}_{number}{dot}{suffix if dot else ''}", number + 1
            names[key] = candidate
        return names[key]

    return tuple(
        material.with_textures(lambda texture: replace(texture, name=own_name(texture))) for material in materials
    )

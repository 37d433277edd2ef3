"""A face: the thin, typed view of a USD stage; the animation that its skeleton plays, and when."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.core import __version__, tokens
from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.names import did_you_mean, unknown
from facepipe.parts import (
    Animation,
    FaceParts,
    Landmarks,
    Material,
    Mesh,
    PersonBasis,
    PhotoView,
    Skeleton,
    Slider,
    SliderNetwork,
    Texture,
)
from facepipe.rig import Person, Rig, build, person_of, sample_transforms, sample_weights, slide
from facepipe.rig.sliders import mode_weights
from facepipe.stage.composition import check_arrays
from facepipe.stage.files import check_units, level_names, open_stage, over, stage_at
from facepipe.stage.material_variants import Variants, read_variants
from facepipe.stage.materials import Images, author_texture, read_material, textures_of
from facepipe.stage.prims import INSTANCES, check_kinds, distinct_names, editable, is_applied, prims_below
from facepipe.stage.read_mesh import Binding, read_mesh, read_point_values
from facepipe.stage.skeleton import author_source, read_animation, read_limits, read_recipe, read_skeleton, read_vrm
from facepipe.stage.sliders import check_face_network, read_person_basis, read_slider_network, read_sliders
from facepipe.stage.uv_transforms import with_baked_uvs
from facepipe.stage.values import errors_below, usd_errors

if TYPE_CHECKING:
    import trimesh

    from facepipe.stage.textures import NewTextures

Read = TypeVar("Read")
OF_NEUTRAL = ("meshes", "skeleton", "animations")  # what follows from it


class Face:
    """One face on a stage. Arrays are read once, when first asked for; the stage is the source of truth.

    Points of all meshes stand one after another in stage order wherever a function takes or gives `points`.
    """

    def __init__(self, stage: Usd.Stage, prim: Usd.Prim | None = None) -> None:
        """:raises SchemaError: no face on the stage, one of a newer facepipe, bad units, or not exactly one Skeleton
        :raises InputError: more prims than a face can have
        """
        self.stage = stage
        if not prim:  # none, or one that is not there
            first = [stage.GetDefaultPrim()] if stage.GetDefaultPrim() else []
            prim = next((one for one in (*first, *stage.Traverse()) if is_applied(one, tokens.FACE_API)), None)
        if not prim:
            file = Path(stage.GetRootLayer().realPath or "stage").name
            what = "no prim with FacepipeFaceAPI; `facepipe import usd` makes a face of other UsdSkel files"
            raise SchemaError(file, what)
        self.prim = prim
        made_by = str(self.prim.GetAttribute(tokens.VERSION).Get() or "0")
        major = made_by.partition(".")[0]
        if major.isdecimal() and int(major) > int(__version__.partition(".")[0]):
            raise SchemaError(self.where, f"made by facepipe {made_by}, expected {__version__} or older")
        check_units(self.where, self.stage)
        below = list(self._below())  # counted before anything is read: damaged files promise more than memory holds
        check_kinds(below, self.where)
        check_arrays(below, self.where)
        skeletons = [prim for prim in below if prim.IsA(UsdSkel.Skeleton)]
        if len(skeletons) != 1:
            raise SchemaError(self.where, f"{len(skeletons)} Skeleton prims, expected one")
        self._skeleton_prim = skeletons[0]

    file: Path | None = None  # that it comes from, where its stage is of no file: for messages
    warnings: tuple[str, ...] = ()  # what could not be read of the file that it was imported from
    _new_textures: NewTextures | None = None  # of a layer that is being made

    @classmethod
    def from_parts(cls, parts: FaceParts) -> Face:
        """A face authored on a stage in memory, which names its textures; `save` needs a file (`save_parts`)."""
        from facepipe.stage.author import author

        face = cls(author(parts))
        if textures_of(parts):
            face.__dict__["materials"] = parts.materials  # with the textures' bytes, which the stage lacks
        return face

    @property
    def where(self) -> str:
        """The trail to the face for messages: file and prim path."""
        file = self.stage.GetRootLayer().realPath or self.file
        path = f"<{self.prim.GetPath()}>"
        return f"{Path(file).name} -> {path}" if file else path

    @property
    def name(self) -> str:
        """Name of the face prim."""
        return str(self.prim.GetName())

    @property
    def meters_per_unit(self) -> float:
        """Metres in one stage unit."""
        return float(UsdGeom.GetStageMetersPerUnit(self.stage))

    @property
    def mm_per_unit(self) -> float:
        """Millimetres in one stage unit."""
        return self.meters_per_unit * 1000.0

    @property
    def up_axis(self) -> str:
        """``Y`` or ``Z``."""
        return str(UsdGeom.GetStageUpAxis(self.stage))

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """The meshes in stage order, names unique, with the neutral of the face's section where it has one.

        :raises SchemaError: a mesh that doesn't follow the stage convention, or a section of another face or basis
        :raises TopologyError: one whose arrays don't fit each other
        """
        return self._meshes if self._rebuilt is None else self._rebuilt.meshes

    @cached_property
    def skeleton(self) -> Skeleton:
        """The skeleton; without joints for a blendshape-only face."""
        return self._skeleton if self._rebuilt is None else self._rebuilt.skeleton

    @cached_property
    def animations(self) -> tuple[Animation, ...]:
        """Poses and clips below the face."""
        return self._animations if self._rebuilt is None else self._rebuilt.animations

    @cached_property
    def person_basis(self) -> PersonBasis | None:
        """What its person is relative to; None for most faces of others."""
        with errors_below(self.where):
            return read_person_basis(self.prim)

    @cached_property
    def authored(self) -> FaceParts:
        """What stands on the stage of meshes, skeleton and animations, where `meshes` has a section in their place."""
        return FaceParts(
            name=self.name,
            meters_per_unit=self.meters_per_unit,
            up_axis="Z" if self.up_axis == "Z" else "Y",
            meshes=self._meshes,
            skeleton=self._skeleton,
            animations=self._animations,
            person_basis=self.person_basis,
        )

    @cached_property
    def _rebuilt(self) -> FaceParts | None:
        """The face of its section; None: it has none."""
        if self.person_basis is None or not self.person_basis.section:
            return None
        from facepipe.rig.identity import neutrals

        return self._finite(neutrals().with_section(self.authored, self.where))

    @cached_property
    def _meshes(self) -> tuple[Mesh, ...]:
        prims = [prim for prim in self._below() if prim.IsA(UsdGeom.Mesh)]
        own = distinct_names(prims, [str(prim.GetPath().MakeRelativePath(self.prim.GetPath())) for prim in prims])
        with errors_below(self.where):
            cache, root = UsdSkel.Cache(), UsdSkel.Root(self.prim)
            if not root:
                raise SchemaError(self.where, f"is of type '{self.prim.GetTypeName()}', expected SkelRoot")
            cache.Populate(root, INSTANCES)
            bound = cache.ComputeSkelBindings(root, INSTANCES)
            # as UsdSkel binds them, which looks at what is inherited; a mesh that it skips is not deformed by it either
            bindings = {
                str(query.GetPrim().GetPath()): Binding(query, self._skeleton.joints)
                for binding in bound
                for query in binding.GetSkinningTargets()
            }
            rows = zip(prims, own, strict=True)
            read = [read_mesh(one, name, bindings.get(str(one.GetPath())), self.material_names) for one, name in rows]
            return self._finite(tuple(read))

    @cached_property
    def _skeleton(self) -> Skeleton:
        with errors_below(self.where):
            return read_skeleton(self._skeleton_prim)

    @cached_property
    def _animations(self) -> tuple[Animation, ...]:
        with errors_below(self.where):
            return self._finite(tuple(read_animation(prim, name) for name, prim in animation_prims(self).items()))

    @property
    def played(self) -> str | None:
        """Name of the pose or clip below the face that its skeleton plays."""
        with errors_below(self.where):
            source = UsdSkel.BindingAPI(self._skeleton_prim).GetInheritedAnimationSource()
        return next((name for name, prim in animation_prims(self).items() if prim == source), None)

    @property
    def frames_per_second(self) -> float:
        """Time codes of the stage in a second."""
        return float(self.stage.GetTimeCodesPerSecond()) or 24.0

    @cached_property
    def sliders(self) -> tuple[Slider, ...]:
        """The face's sliders, by name."""
        with errors_below(self.where):
            return self._finite(read_sliders(self.prim))

    @cached_property
    def slider_network(self) -> SliderNetwork | None:
        """The learned network that adds to what the sliders do; None for most faces."""
        with errors_below(self.where):
            return self._finite(read_slider_network(self.prim))

    @cached_property
    def materials(self) -> tuple[Material, ...]:
        """Its UsdPreviewSurface materials, with their textures."""
        with errors_below(self.where):
            images: Images = {}
            named = ((self.stage.GetPrimAtPath(path), name) for path, name in self.material_names.items())
            read = [read_material(prim, name, images) for prim, name in named]
            variants = self.material_variants.of_materials(self.where, self.material_names)
            found = (replace(one, variants=variants.get(one.name, {})) for one in read if one is not None)
            return self._finite(tuple(found))

    @cached_property
    def material_variants(self) -> Variants:
        """The variants of its materials, by the prims that they change."""
        with errors_below(self.where):
            return read_variants(self.prim, self.where)

    @cached_property
    def photos(self) -> tuple[PhotoView, ...]:
        """Photos that it was fitted to."""
        with errors_below(self.where):
            cameras = [prim for prim in self._below() if prim.IsA(UsdGeom.Camera)]
            if not cameras:  # most faces: their export loads one module less
                return ()
            from facepipe.stage.photos import is_photo, read_photo

            return self._finite(tuple(read_photo(camera) for camera in cameras if is_photo(camera)))

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of its blendshapes, each once, in the order of the meshes."""
        return tuple(dict.fromkeys(shape.name for mesh in self.meshes for shape in mesh.blendshapes))

    @property
    def attach_joint(self) -> str | None:
        """Joint of a body skeleton that the root joints hang under."""
        return self._text(tokens.ATTACH_JOINT) or None

    @property
    def levels(self) -> tuple[str, ...]:
        """Names of its levels of detail, finest first, itself included; none for most faces."""
        return level_names(self.prim)

    def at_level(self, number: int) -> Face:
        """The face at one of its levels, 0 the finest, on a stage of its own over the same layers.

        :raises InputError: no such level
        """
        names = self.levels
        if not 0 <= number < len(names):
            expected = f"expected 0 to {len(names) - 1}" if names else "the face has none (`facepipe lod` makes some)"
            raise InputError(self.where, f"no level of detail {number}, {expected}")
        stage = stage_at(self.stage, self.prim.GetPath(), names[number])
        face = Face(stage, stage.GetPrimAtPath(self.prim.GetPath()))
        if number and self.person_basis is not None:  # lower levels were made of what section and modes give
            sliders = tuple(replace(slider, modes=()) for slider in self.sliders)
            face.__dict__ |= {"person_basis": replace(self.person_basis, section=b""), "sliders": sliders}
        return face

    def lower_levels(self) -> tuple[FaceParts, ...]:
        """The face at each lower level of detail, finest first, as arrays."""
        return tuple(self.at_level(number).parts() for number in range(1, len(self.levels)))

    def with_identity(self, sliders: Mapping[str, float] | None = None) -> Face:
        """The face whose neutral has what sliders do to it by modes of its basis; itself where they do nothing.

        :param sliders: values by name; those not named have the values authored on the stage
        :raises InputError: a face that is not of that basis
        """
        return self._with_identity(sliders) if sliders else self._identity

    @cached_property
    def _identity(self) -> Face:
        return self._with_identity(None)

    def _with_identity(self, sliders: Mapping[str, float] | None) -> Face:
        if not mode_weights(self.sliders, sliders):
            return self
        from facepipe.rig.identity import with_identity

        parts = self.parts()
        with errors_below(self.where):
            changed = with_identity(parts, sliders)
        face = Face(self.stage, self.prim)
        face.__dict__ |= self.__dict__ | {name: getattr(changed, name) for name in (*OF_NEUTRAL, "sliders")}
        for name in ("_rig", "head_height", "_identity"):
            face.__dict__.pop(name, None)
        return face

    def landmarks(self, scheme: str = "multipie68") -> tuple[Mesh, Landmarks]:
        """The mesh that has landmarks of `scheme`, and these.

        :raises SchemaError: no mesh has them
        """
        for mesh in self.meshes:
            if scheme in mesh.landmarks:
                return mesh, mesh.landmarks[scheme]
        schemes = sorted({landmark for mesh in self.meshes for landmark in mesh.landmarks})
        raise SchemaError(self.where, unknown(scheme, schemes, "landmarks of scheme"))

    def parts(self) -> FaceParts:
        """Everything the face holds, as arrays."""
        with errors_below(self.where):
            limits = read_limits(self._skeleton_prim, len(self.skeleton.joints))
            recipe = read_recipe(self.prim)
            vrm = read_vrm(self.prim)
        parts = FaceParts(  # without levels, which are faces of their own
            name=self.name,
            meters_per_unit=self.meters_per_unit,
            up_axis="Z" if self.up_axis == "Z" else "Y",
            meshes=self.meshes,
            skeleton=self.skeleton,
            animations=self.animations,
            played=self.played,
            frames_per_second=self.frames_per_second,
            sliders=self.sliders,
            slider_network=self.slider_network,
            bone_limits=limits,
            materials=self.materials,
            attach_joint=self.attach_joint,
            person=self._text(tokens.PERSON) or None,
            person_basis=None if self.person_basis is None else replace(self.person_basis, section=b""),
            attribution=self._text(tokens.ATTRIBUTION),
            vrm=vrm,
            photos=self.photos,
            recipe=recipe,
        )
        check_face_network(self.where, parts, SchemaError)
        baked = with_baked_uvs(parts)
        # what is big was walked when it was read: to walk it at every call took a blend, which asks six times, 0.3 s
        walked = replace(parts, meshes=(), animations=(), sliders=(), slider_network=None, materials=())
        self._finite(walked if baked is parts else baked)
        return baked

    def rig(self) -> Rig:
        """The rig: what moves the points."""
        return self._rig

    @cached_property
    def _rig(self) -> Rig:
        with errors_below(self.where):
            return build(FaceParts(name=self.name, meshes=self.meshes, skeleton=self.skeleton))

    @cached_property
    def head_height(self) -> float:
        """Height of the neutral's rest bounding box over all meshes, in stage units."""
        points = self._rig.evaluate()
        return float(np.ptp(points[:, 2 if self.up_axis == "Z" else 1])) if len(points) else 0.0

    def evaluate(
        self,
        weights: Mapping[str, float] | None = None,
        *,
        coefficients: FloatArray | None = None,
        joint_transforms: FloatArray | None = None,
        parent_world: FloatArray | None = None,
        sliders: Mapping[str, float] | None = None,
        pose: str = "rest",
    ) -> FloatArray:
        """(n, 3) world points in stage units, float64.

        Expressions play on top of a person, that of `pose` or of `sliders`: local transforms are
        ``rest M(person) M(expression)``, shape weights add.

        :param weights: shape weights by name
        :param coefficients: (j, 9) bone coefficients of the expression: stage units, radians, factors
        :param joint_transforms: (j, 4, 4) local joint transforms as they are, instead of coefficients and person
        :param parent_world: (4, 4) world matrix of the body joint that the face hangs under
        :param sliders: slider values by name that make the person; those not named have the values authored on the
            stage (None ignores the sliders)
        :param pose: the person without `sliders`: ``rest`` is the template, ``set`` what is set on the face, else an
            animation's first sample
        :raises InputError: unknown names, wrong counts or non-finite values
        """
        if joint_transforms is not None and (sliders is not None or pose != "rest"):
            raise InputError(self.where, "a person and joint transforms, expected only one of them")
        if (other := self if pose == "rest" and sliders is None else self.with_identity(sliders)) is not self:
            return other.evaluate(
                weights,
                coefficients=coefficients,
                joint_transforms=joint_transforms,
                parent_world=parent_world,
                sliders=sliders,
                pose=pose,
            )
        person = self._person_of(sliders, pose)
        if person is not None and coefficients is not None:
            # coefficients do not add, as angles of two turns don't: their matrices are multiplied
            joint_transforms = self._rig.rest @ person.under(self._rig.checked_coefficients(coefficients))
            coefficients = None
        elif person is not None:
            coefficients = person.coefficients
        return self._rig.evaluate(
            weights if person is None else person.weights_under(weights or {}),
            coefficients=coefficients,
            joint_transforms=joint_transforms,
            parent_world=parent_world,
        )

    def shape_weights(
        self, weights: Mapping[str, float], *, sliders: Mapping[str, float] | None = None, pose: str = "rest"
    ) -> Mapping[str, float]:
        """The weight of every shape that `evaluate` moves points by, of the same person and expression."""
        person = self._person_of(sliders, pose)
        return weights if person is None else person.weights_under(weights)

    def _person_of(self, sliders: Mapping[str, float] | None, pose: str) -> Person | None:
        if sliders is not None and pose != "rest":
            raise InputError(self.where, f"sliders and pose '{pose}', expected only one of them")
        if sliders is None:
            return self.person(pose) if pose != "rest" else None
        own, driven = slide(self.sliders, self.skeleton.joints, sliders, self.slider_network)
        return Person(description="sliders", coefficients=own, weights=driven)

    def person(self, pose: str = "set") -> Person:
        """Who the face is, as `facepipe.rig.person_of` says.

        :raises InputError: no such pose
        """
        with errors_below(self.where):
            return person_of(self.parts(), pose)

    def sample(self, name: str, index: int = 0) -> tuple[FloatArray, dict[str, float]]:
        """Local joint transforms (j, 4, 4) and shape weights of one sample of an animation.

        :raises InputError: no such animation or sample, or joints and shapes that the face lacks
        """
        animation = next((candidate for candidate in self.animations if candidate.name == name), None)
        if animation is None:
            raise InputError(self.where, unknown(name, [candidate.name for candidate in self.animations], "animation"))
        count = animation.samples
        if not 0 <= index < count:
            raise InputError(f"{self.where} -> {name}", f"no sample {index}, expected 0 to {count - 1}")
        return sample_transforms(self.skeleton, animation, index), sample_weights(animation, index)

    def to_trimesh(self, pose: str = "set") -> trimesh.Scene:
        """The meshes that have faces as a `trimesh.Scene`, at rest as exporters deliver them: metres, Y up.

        Each geometry is called as its mesh and has the mesh's points as vertices, one each and in their order. Faces
        are fans of triangles; display colours become vertex colours. UVs and materials are left out: they would split
        points at seams.

        :param pose: who it is, as of `person`
        :raises InputError: no such pose
        """
        import trimesh

        from facepipe.geometry.colors import to_srgb
        from facepipe.geometry.polygons import point_triangles

        points = self.evaluate(pose=pose) * self.meters_per_unit
        if self.up_axis == "Z":
            points = points[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        scene, split = trimesh.Scene(), self.split(points)
        for mesh in self.meshes:
            to_world = mesh.transform if mesh.skin is None else self.skeleton.transform @ mesh.skin.geom_bind_transform
            triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
            if np.linalg.det(to_world[:3, :3]) < 0:  # a mirror turns them inside out
                triangles = triangles[:, ::-1]
            a, b, c = triangles.T
            triangles = triangles[(a != b) & (b != c) & (c != a)]
            if len(triangles):
                colors = None if mesh.colors is None else np.rint(to_srgb(mesh.colors) * 255).astype(np.uint8)
                surface = trimesh.Trimesh(split[mesh.name], triangles, vertex_colors=colors, process=False)
                scene.add_geometry(surface, geom_name=mesh.name, node_name=mesh.name)
        scene.units = "m"
        return scene

    def split(self, points: FloatArray) -> dict[str, FloatArray]:
        """Per-mesh views of (n, ...) values of all points."""
        return self._rig.split(points)

    def primvar(self, name: str) -> FloatArray:
        """(n,) values of a per-point float primvar over all meshes; NaN on meshes without it.

        :raises InputError: no mesh has it
        """
        prims = [self.mesh_prim(mesh.name) for mesh in self.meshes]
        values = [
            read_point_values(prim, name, len(mesh.points)) for prim, mesh in zip(prims, self.meshes, strict=True)
        ]
        if not any(np.isfinite(value).any() for value in values):
            regions = {f"{tokens.REGION_PRIMVAR}{region}" for mesh in self.meshes for region in mesh.regions}
            near = did_you_mean(name, sorted(regions))
            raise InputError(self.where, f"no primvar '{name}' with one number per point{near}")
        return np.concatenate(values)

    @contextlib.contextmanager
    def deriving(self, path: str | os.PathLike[str], *, flatten: bool = False) -> Iterator[Face]:
        """The same face over a new override layer, saved as `path` when the block ends well.

        A .usdz, and any file with `flatten`, is standalone instead.

        :raises InputError: `path` can't be written, is the source itself, or the source was never saved
        """
        from facepipe.stage.textures import NewTextures, save_standalone

        target, base = Path(path).absolute(), self.stage.GetRootLayer()
        flatten = flatten or target.suffix.lower() == ".usdz"
        if not (flatten or base.realPath):
            raise InputError(path, "the source was never saved, expected one with a file to refer to (or flatten)")
        stage = Usd.Stage.Open(over(base, target))
        face = Face(stage, stage.GetPrimAtPath(self.prim.GetPath()))
        with NewTextures() as textures:
            face._new_textures = textures
            yield face
            if flatten:
                save_standalone(stage, path, textures.files)
                return
            # a copy: its texture paths and sublayer change, while the face goes on reading the layer of its own stage
            written = Sdf.Layer.CreateAnonymous(".usda")
            written.TransferContent(stage.GetRootLayer())
            textures.save(written, target, base.realPath)

    def new_texture(self, materials: Sequence[str], name: str, data: bytes, field: str = "diffuse_color") -> None:
        """Give materials another image for their colour's texture, or that of another field, within `deriving`.

        The image is written beside the layer when that is saved; faces that are read from the stage later have it.

        :param materials: by name
        :param name: of the file, with extension
        :param data: of an image, of colours in sRGB
        :param field: of `Material`
        :raises InputError: no layer is being made, no such material, or one without a texture
        """
        if self._new_textures is None:
            raise InputError(self.where, "no layer to put textures on, expected a face within `deriving`")
        paths = {label: path for path, label in self.material_names.items()}
        unknown_names = [material for material in materials if material not in paths]
        if unknown_names:
            raise InputError(self.where, unknown(unknown_names[0], list(paths), "material"))
        # by its absolute path until the layer is saved: a layer without a file has no folder for relative ones
        asset = self._new_textures.add(name, data)
        for material in materials:
            author_texture(self.stage.GetPrimAtPath(paths[material]), field, asset)
            self._new_textures.shown[material, field] = Texture(name=name, data=data)

    def parts_so_far(self) -> FaceParts:
        """The parts with what is authored so far within `deriving`, new textures too."""
        parts = Face(self.stage, self.prim).parts()
        shown = {} if self._new_textures is None else self._new_textures.shown
        changes: dict[str, dict[str, Any]] = {material.name: {} for material in parts.materials}
        for (material, field), texture in shown.items():
            source = next(getattr(candidate, field) for candidate in parts.materials if candidate.name == material)
            changes[material][field] = replace(source, texture=texture)
        return replace(parts, materials=tuple(replace(one, **changes[one.name]) for one in parts.materials))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Save the face as one standalone file, atomically; textures go beside it, or into a .usdz."""
        from facepipe.stage.textures import save_standalone

        save_standalone(self.stage, path)

    def mesh_prim(self, name: str) -> Usd.Prim:
        """The prim of the mesh called `name`.

        :raises InputError: no such mesh
        """
        prims = [prim for prim in self._below() if prim.IsA(UsdGeom.Mesh)]
        for prim, mesh in zip(prims, self.meshes, strict=True):
            if mesh.name == name:
                return prim
        raise InputError(self.where, unknown(name, [mesh.name for mesh in self.meshes], "mesh"))

    def _finite(self, read: Read) -> Read:
        require_finite(read, self.where.partition(" -> ")[0], error=SchemaError)
        return read

    def _text(self, name: str) -> str:
        with errors_below(self.where):
            return str(self.prim.GetAttribute(name).Get() or "")

    def _below(self) -> Iterator[Usd.Prim]:
        return prims_below(self.prim, self.where)

    @cached_property
    def material_names(self) -> dict[str, str]:
        """Prim path of each material -> what it is called."""
        prims = [prim for prim in self._below() if prim.IsA(UsdShade.Material)]
        paths = [str(prim.GetPath()) for prim in prims]
        return dict(zip(paths, distinct_names(prims, paths), strict=True))


def animation_prims(face: Face) -> dict[str, Usd.Prim]:
    """The SkelAnimations below a face, by what each is called."""
    prims = [prim for prim in prims_below(face.prim, face.where) if prim.IsA(UsdSkel.Animation)]
    return dict(zip(distinct_names(prims, [str(prim.GetPath()) for prim in prims]), prims, strict=True))


def open_face(path: str | os.PathLike[str]) -> Face:
    """Open the face of a USD file.

    :raises InputError: no such file, or no readable USD
    :raises SchemaError: a stage without a face
    """
    with usd_errors(path):
        return Face(open_stage(path))


def play(face: Face, name: str) -> None:
    """Author an animation of the face as its skeleton's source: what opens the stage shows the face in it.

    :raises InputError: no such animation
    """
    prim = animation_prims(face).get(name)
    if prim is None:
        raise InputError(face.where, unknown(name, [animation.name for animation in face.animations], "animation"))
    author_source(editable(_skeleton_prim(face)), prim.GetPath())


def moving_animation(face: Face) -> Animation | None:
    """What moves a face: the animation that its skeleton plays, else the only one over time; None where there is none.

    :raises InputError: NaN, or several over time of which the skeleton plays none
    :raises TopologyError: arrays that don't fit the joints or shapes
    """
    with usd_errors(face.where):
        source = UsdSkel.BindingAPI(_skeleton_prim(face)).GetInheritedAnimationSource()
    if source and source.IsA(UsdSkel.Animation):
        played = read_animation(source)
        require_finite(played, f"{face.where} -> {source.GetPath()}")
        return played
    moving = [animation for animation in face.animations if animation.times is not None]
    if len(moving) > 1:
        some = ", ".join(animation.name for animation in moving[:6])
        raise InputError(
            face.where, f"{len(moving)} animations over time ({some}), expected one, or one that the skeleton plays"
        )
    return moving[0] if moving else None


def on_frames(face: Face, seconds: FloatArray) -> FloatArray:
    """(T,) seconds; those that are a whole time code of the stage in float32 become exactly that."""
    rate = face.stage.GetTimeCodesPerSecond()
    whole = np.rint(np.asarray(seconds, dtype=np.float64) * rate) / rate
    return np.where(whole.astype(np.float32) == np.asarray(seconds, dtype=np.float32), whole, seconds)


def _skeleton_prim(face: Face) -> Usd.Prim:
    return next(prim for prim in prims_below(face.prim, face.where) if prim.IsA(UsdSkel.Skeleton))

"""The parts of a face as plain numpy arrays: what importers make, the stage stores, and exporters read.

Matrices are (4, 4) float64 in the column-vector convention (``world = M @ local``). Points and offsets are in stage
units, rotations are quaternions ``x, y, z, w``. The stage (`facepipe.stage`) is the only place that turns them
into USD values and back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError


class Named(Protocol):
    """What has a name of its own, and perhaps another in its source."""

    @property
    def name(self) -> str:
        """What it is called here."""

    @property
    def label(self) -> str | None:
        """What its source calls it, where that is another."""


def exact(one: Named) -> str:
    """What the source calls it."""
    return one.name if one.label is None else one.label


def identity() -> FloatArray:
    """A (4, 4) identity matrix."""
    return np.eye(4)


Sculpt = TypeVar("Sculpt", "Blendshape", "Inbetween")


@dataclass(frozen=True, kw_only=True)
class Inbetween:
    """An extra sculpt of a blendshape, reached at `weight` (0 < weight, not 1)."""

    name: str
    weight: float
    offsets: FloatArray  # (k, 3), parallel to the blendshape's point_indices
    normal_offsets: FloatArray | None = None  # (k, 3)


@dataclass(frozen=True, kw_only=True)
class Blendshape:
    """Sparse point offsets of one mesh; the same name on several meshes is one shape of the face."""

    name: str  # any text, once on a mesh
    point_indices: IntArray  # (k,) int32, ascending, unique
    offsets: FloatArray  # (k, 3)
    normal_offsets: FloatArray | None = None  # (k, 3)
    inbetweens: tuple[Inbetween, ...] = ()
    label: str | None = None  # the source's name, where `name` had to be another: several are called so, or ""

    @property
    def sculpts(self) -> tuple[tuple[str, float, Blendshape | Inbetween], ...]:
        """The shape and its inbetweens: of each the name as a morph target, the weight, and what has its offsets."""
        between = ((f"{self.name}_{inbetween.name}", inbetween.weight, inbetween) for inbetween in self.inbetweens)
        return ((self.name, 1.0, self), *between)

    def changed(
        self, offsets: Callable[[FloatArray], FloatArray], normal_offsets: Callable[[FloatArray], FloatArray]
    ) -> Blendshape:
        """The shape with other (k, 3) offsets of points and, where it has them, of normals; its inbetweens too."""

        def sculpt(one: Sculpt) -> Sculpt:
            normals = None if one.normal_offsets is None else normal_offsets(one.normal_offsets)
            return replace(one, offsets=offsets(one.offsets), normal_offsets=normals)

        return replace(sculpt(self), inbetweens=tuple(map(sculpt, self.inbetweens)))


@dataclass(frozen=True, kw_only=True)
class Skin:
    """Skin weights of one mesh; influences beyond a point's own have weight 0 and index 0."""

    joint_indices: IntArray  # (n, influences) int32, into Skeleton.joints
    joint_weights: FloatArray  # (n, influences)
    geom_bind_transform: FloatArray = field(default_factory=identity)  # mesh space -> skeleton space at bind time
    dual_quaternion: bool = False  # skel:skinningMethod dualQuaternion; else joints blend linearly


@dataclass(frozen=True, kw_only=True)
class UvSet:
    """Texture coordinates, v up as in USD. `indices` None: one value per point (n, 2)."""

    name: str = "st"
    values: FloatArray  # (u, 2)
    indices: IntArray | None = None  # (face corners,) int32 into values: face-varying


@dataclass(frozen=True, kw_only=True)
class Landmarks:
    """Named points of one scheme (``multipie68``)."""

    indices: IntArray  # (l,) int32 point indices
    names: tuple[str, ...] = ()  # empty, or one name per landmark


@dataclass(frozen=True, kw_only=True)
class MaterialFaces:
    """The faces of a mesh that use one material."""

    material: str
    faces: IntArray  # (m,) int32 face indices


@dataclass(frozen=True, kw_only=True)
class Holds:
    """What n points of a mesh lie on: a place on a triangle of another mesh's points each, and the way from there."""

    mesh: str  # of a face
    corners: IntArray  # (n, 3) its points
    shares: FloatArray  # (n, 3) in sum 1
    offsets: FloatArray  # (n, 3) mesh space


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """One polygon mesh of a face."""

    name: str  # any text, once on a face
    points: FloatArray  # (n, 3) mesh space
    face_vertex_counts: IntArray  # (faces,) int32
    face_vertex_indices: IntArray  # (corners,) int32
    transform: FloatArray = field(default_factory=identity)  # mesh space -> world
    normals: FloatArray | None = None  # (n, 3) per point, or (corners, 3) face-varying
    uv_sets: tuple[UvSet, ...] = ()
    colors: FloatArray | None = None  # (n, 3) display colour per point, linear 0..1
    skin: Skin | None = None
    blendshapes: tuple[Blendshape, ...] = ()
    regions: Mapping[str, FloatArray] = field(default_factory=dict)  # name -> (n,) soft mask 0..1
    point_subsets: Mapping[str, IntArray] = field(default_factory=dict)  # name -> point indices (hard regions)
    landmarks: Mapping[str, Landmarks] = field(default_factory=dict)  # scheme -> landmarks
    anchor: int | None = None  # a point on the neck border
    material: str | None = None  # bound to the whole mesh
    material_faces: tuple[MaterialFaces, ...] = ()  # stronger, face by face
    double_sided: bool = False
    label: str | None = None  # as of a blendshape
    data_label: str | None = None  # the source's name of the geometry, where the node that shows it has another
    holds: Holds | None = None  # for devices that move that mesh's points; stages do not keep it


def material_faces(names: Sequence[str], face_material: IntArray) -> tuple[MaterialFaces, ...]:
    """Faces by material; `face_material` (f,) indexes `names`, -1 for faces without."""
    order = np.argsort(face_material, kind="stable")
    used, starts = np.unique(face_material[order], return_index=True)
    return tuple(
        MaterialFaces(material=names[number], faces=faces.astype(np.int32))
        for number, faces in zip(used, np.split(order, starts[1:]), strict=False)
        if number >= 0
    )


def bindings(materials: Sequence[str | None], slots: IntArray) -> tuple[str | None, tuple[MaterialFaces, ...]]:
    """The material of all faces, or faces by material: of the slot (f,) of each; slots beyond the last hold none."""
    names = [*dict.fromkeys(name for name in materials if name is not None)]
    numbers = {name: number for number, name in enumerate(names)}
    of_slot = np.array([*(-1 if name is None else numbers[name] for name in materials), -1])
    of_face = of_slot[np.minimum(slots, len(materials))]
    used = np.unique(of_face)
    if len(used) != 1:
        return None, material_faces(names, of_face)
    return (names[used[0]] if used[0] >= 0 else None), ()


def all_regions(meshes: Sequence[Mesh]) -> dict[str, FloatArray]:
    """Region -> mask (n,) over the points of all meshes, by name; 0 on meshes without it."""
    names = sorted({name for mesh in meshes for name in mesh.regions})
    return {
        name: np.concatenate([mesh.regions.get(name, np.zeros(len(mesh.points), np.float32)) for mesh in meshes])
        for name in names
    }


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """Joints parent first. A blendshape-only face has one with no joints."""

    name: str = "Skeleton"
    joints: tuple[str, ...] = ()  # paths of identifiers: "root/neck/jaw"
    joint_names: tuple[str, ...] = ()  # the source's name of each; none: the last parts of the paths
    bind_transforms: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (j, 4, 4) world
    rest_transforms: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (j, 4, 4) local to parent
    transform: FloatArray = field(default_factory=identity)  # skeleton space -> world

    @property
    def names(self) -> tuple[str, ...]:
        """What each joint is called: the source's names, else the last parts of the paths."""
        return self.joint_names or tuple(joint.rpartition("/")[2] for joint in self.joints)

    def called(self, names: Sequence[str]) -> Skeleton:
        """The same skeleton, its joints called `names`."""
        bare = replace(self, joint_names=())
        # names that several joints have stand for themselves: without them an exporter would write paths
        known = tuple(names) == bare.names and len({*names}) == len(names)
        return bare if known else replace(self, joint_names=tuple(names))

    @property
    def parents(self) -> IntArray:
        """(j,) int32 index of each joint's parent, -1 for a root."""
        index = {joint: i for i, joint in enumerate(self.joints)}
        parents = []
        for joint in self.joints:
            parent = joint.rpartition("/")[0]
            while parent and parent not in index:  # a part of the path that is no joint
                parent = parent.rpartition("/")[0]
            parents.append(index.get(parent, -1))
        return np.array(parents, dtype=np.int32)


@dataclass(frozen=True, kw_only=True)
class Animation:
    """Joint transforms and shape weights, one pose (`times` None) or T samples.

    Joint transforms are local (relative to the parent joint, rest included). `coefficients` are the same motion as
    bone coefficients relative to rest (DESIGN section 7) and win over the transforms where both are given.
    """

    name: str
    times: FloatArray | None = None  # (T,) seconds, ascending; None: one static pose, T = 1
    joints: tuple[str, ...] = ()
    translations: FloatArray | None = None  # (T, j, 3)
    rotations: FloatArray | None = None  # (T, j, 4) quaternions x y z w
    scales: FloatArray | None = None  # (T, j, 3)
    coefficients: FloatArray | None = None  # (T, j, 9): t (stage units), r (radians), s
    shapes: tuple[str, ...] = ()
    shape_weights: FloatArray | None = None  # (T, shapes)
    label: str | None = None  # as of a blendshape

    @property
    def samples(self) -> int:
        """T, 1 for a pose."""
        return 1 if self.times is None else len(self.times)


# At least two knots (slider value, amount): values strictly ascending, amounts never turning back (monotone). Straight
# lines between them, constant beyond the ends.
Curve = tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True)
class Slider:
    """A user control that adds to bone coefficient channels and shape weights.

    An entry of `channels` or `shapes` adds ``gain * (value - default)``, or ``gain * curve(value)`` where it has a
    curve; one of `modes` the first, to the neutral, where a face is set (`facepipe.rig.identity`). The value is clamped
    to minimum..maximum first.
    """

    name: str
    group: str = ""
    default: float = 0.0
    minimum: float = 0.0
    maximum: float = 1.0
    value: float | None = None  # current setting; None: the default
    channels: tuple[tuple[str, str, float], ...] = ()  # (joint path, tx ty tz rx ry rz sx sy sz, gain)
    shapes: tuple[tuple[str, float], ...] = ()  # (blendshape name, gain)
    channel_curves: tuple[Curve | None, ...] = ()  # empty, or one per channel; None: straight
    shape_curves: tuple[Curve | None, ...] = ()  # empty, or one per shape; None: straight
    mirror: str | None = None  # the slider of the other side, whose mirror this one is
    modes: tuple[tuple[int, float], ...] = ()  # (mode of the face's basis, gain in its standard deviations)

    @property
    def setting(self) -> float:
        """Its value, or its default where none is set."""
        return self.default if self.value is None else self.value


@dataclass(frozen=True, kw_only=True)
class SliderNetwork:
    """A learned network that adds to what the sliders do, from the values of several at once.

    ``x`` is the clamped values of `sliders`. Every layer makes it ``weight @ x + bias``, and every layer but the last
    then applies the activation; what the last one gives is added to `channels`, then `shapes`.
    """

    sliders: tuple[str, ...]
    channels: tuple[tuple[str, str], ...] = ()  # (joint path, tx ty tz rx ry rz sx sy sz)
    shapes: tuple[str, ...] = ()  # blendshape names
    weights: tuple[FloatArray, ...]  # (out, in) of each layer
    biases: tuple[FloatArray, ...]  # (out,) of each layer
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    info: Mapping[str, object] = field(default_factory=dict)  # how it was made: JSON values

    @property
    def layers(self) -> list[int]:
        """Its inputs, and the units of each layer."""
        return [len(self.sliders), *(len(bias) for bias in self.biases)]

    def summary(self) -> dict[str, object]:
        """All but its numbers, as JSON has it."""
        return {
            "activation": self.activation,
            "channels": [list(channel) for channel in self.channels],
            "info": dict(self.info),
            "layers": self.layers,
            "shapes": list(self.shapes),
            "sliders": list(self.sliders),
        }


@dataclass(frozen=True, kw_only=True)
class BoneLimits:
    """Allowed bone coefficients, joints in skeleton order, channels tx ty tz rx ry rz sx sy sz."""

    lower: FloatArray  # (j, 9)
    upper: FloatArray  # (j, 9)


@dataclass(frozen=True, kw_only=True)
class Texture:
    """An image file, whole: name with extension and its bytes."""

    name: str
    data: bytes
    refusal: InputError | None = None  # why there are no bytes: the image may not be copied

    def image(self) -> bytes:
        """The bytes, to be drawn or copied.

        :raises InputError: the refusal
        """
        if self.refusal is not None:
            raise self.refusal
        return self.data


# the rows of a 2 x 3 matrix: (u, v, 1) -> (u', v'), v up
UvTransform = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class TextureInput:
    """A material input read from a texture: ``texel[channels] * scale + bias``."""

    texture: Texture
    channels: Literal["rgb", "r", "g", "b", "a"] = "rgb"
    uv_set: str = "st"
    scale: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    bias: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    wrap_s: Literal["repeat", "mirror", "clamp"] = "repeat"
    wrap_t: Literal["repeat", "mirror", "clamp"] = "repeat"
    uv_transform: UvTransform = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # of readers alone: a face has it in its UV sets


Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class WrinkleRegion:
    """Wrinkles that come together. They are as strong as the sum of shape weights times gains, within 0..1."""

    name: str
    mask: TextureInput  # one channel: where they are
    shapes: tuple[tuple[str, float], ...]  # (blendshape name, gain)

    def strength(self, weights: Mapping[str, float]) -> float:
        """How strong shape weights make them, 0..1."""
        return min(max(sum(gain * weights.get(shape, 0.0) for shape, gain in self.shapes), 0.0), 1.0)


@dataclass(frozen=True, kw_only=True)
class Wrinkles:
    """Wrinkles of a skin at full strength, which its shapes draw on it region by region.

    Where the strengths of regions times their masks sum to s, at most 1, the skin has its own tangent-space normal with
    s times x and y of `normal` added to its x and y, and its base colour times ``1 + s * (tint - 1)``.
    """

    normal: TextureInput  # tangent space, x and y by scale 2 and bias -1
    tint: TextureInput  # factor of the linear base colour: data, no sRGB
    regions: tuple[WrinkleRegion, ...]

    @property
    def inputs(self) -> tuple[TextureInput, ...]:
        """All that is read from textures."""
        return (self.normal, self.tint, *(region.mask for region in self.regions))


@dataclass(frozen=True, kw_only=True)
class Material:
    """A UsdPreviewSurface in the metallic workflow; each input is a value or a texture. Colours are linear."""

    name: str
    diffuse_color: Color | TextureInput = (0.18, 0.18, 0.18)
    emissive_color: Color | TextureInput = (0.0, 0.0, 0.0)
    metallic: float | TextureInput = 0.0
    roughness: float | TextureInput = 0.5
    opacity: float | TextureInput = 1.0
    opacity_threshold: float = 0.0  # above 0: alpha test instead of blending
    occlusion: float | TextureInput = 1.0
    normal: TextureInput | None = None  # tangent space, authored with scale 2 and bias -1
    ior: float = 1.5
    clearcoat: float | TextureInput = 0.0  # a clear layer over it, such as tears or lip gloss
    clearcoat_roughness: float | TextureInput = 0.01
    sheen_color: Color = (0.0, 0.0, 0.0)  # of fine hairs on it: glTF's KHR_materials_sheen, which USD has no word for
    sheen_roughness: float = 0.0
    unlit: bool = False  # shown as its colour is, without light: glTF's KHR_materials_unlit, which USD has no word for
    variants: Mapping[str, str] = field(default_factory=dict)  # variant of the face -> material shown in its place
    wrinkles: Wrinkles | None = None
    label: str | None = None  # as of a blendshape

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Every texture that it reads, those of its wrinkles too."""
        own = (*self.textured.values(), *(self.wrinkles.inputs if self.wrinkles else ()))
        return tuple(used.texture for used in own)

    @property
    def textured(self) -> dict[str, TextureInput]:
        """The inputs that textures drive, by field."""
        return {name: value for name, value in vars(self).items() if isinstance(value, TextureInput)}

    def with_textures(self, change: Callable[[Texture], Texture]) -> Material:
        """The material with other textures in place of its own."""

        def changed(used: TextureInput) -> TextureInput:
            return replace(used, texture=change(used.texture))

        inputs: dict[str, Any] = {name: changed(used) for name, used in self.textured.items()}
        if self.wrinkles is not None:
            inputs["wrinkles"] = replace(
                self.wrinkles,
                normal=changed(self.wrinkles.normal),
                tint=changed(self.wrinkles.tint),
                regions=tuple(replace(one, mask=changed(one.mask)) for one in self.wrinkles.regions),
            )
        return replace(self, **inputs)


@dataclass(frozen=True, kw_only=True)
class KeyLamp:
    """The key light of a photo: a lamp so far away that its rays are parallel. Colours are linear."""

    direction: tuple[float, float, float]  # from the face to the lamp, in camera coordinates, any length but 0
    color: Color  # of a white matt surface that faces it; black would be no lamp
    shine: float = 0.0  # strength of the highlight
    exponent: float = 20.0  # of the highlight's Blinn-Phong lobe


@dataclass(frozen=True, kw_only=True)
class PhotoView:
    """What the face was fitted to: a photo, with the pinhole camera that sees the face as the photo does.

    Camera coordinates are x right, y up, z towards the viewer. Pixels count from the photo's top left corner, x right
    and y down: what is at camera coordinates (x, y, z) shows at ``center + focal * (x, -y) / -z``.
    """

    name: str  # of the camera
    image: str = ""  # file name of the photo
    width: int
    height: int
    transform: FloatArray  # (4, 4) camera -> world
    focal: float  # pixels
    center: tuple[float, float]  # principal point, pixels
    clipping: tuple[float, float]  # nearest and farthest depth that a viewer shows, stage units
    light: FloatArray  # (9, 3) spherical harmonics of red, green and blue, in camera coordinates
    key: KeyLamp | None = None  # beside them; it alone has highlights
    tint: Mapping[str, Color] = field(default_factory=dict)  # material -> linear factor of its colour
    landmark_error: float = 0.0  # mean distance of the face's landmarks from the photo's, pixels
    animation: str | None = None  # the pose that the face has in the photo


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a stage was made, so that it can be made again."""

    verb: str  # "import ict", "landmarks", "blend" ...
    sources: tuple[str, ...] = ()  # paths, relative to the stage where they can be
    digests: tuple[str, ...] = ()  # "sha256:..." per source
    options: Mapping[str, object] = field(default_factory=dict)  # JSON values
    version: str = ""  # facepipe version


@dataclass(frozen=True, kw_only=True)
class PersonBasis:
    """The mean and modes that a face's person is relative to (docs/files.md, "A person on the stage")."""

    name: str  # for people
    digest: str  # hexadecimal
    section: bytes = b""  # the payload of the neutral that is to be in place of the points; b"": these are it


@dataclass(frozen=True, kw_only=True)
class FaceParts:
    """A whole face. Names of meshes, of materials and of animations are any text, each once; joint paths hold USD
    identifiers."""

    name: str = "Face"
    meters_per_unit: float = 0.01
    up_axis: Literal["Y", "Z"] = "Y"
    meshes: tuple[Mesh, ...] = ()
    skeleton: Skeleton = field(default_factory=Skeleton)
    animations: tuple[Animation, ...] = ()
    played: str | None = None  # the animation that the skeleton plays (skel:animationSource)
    frames_per_second: float = 24.0  # time codes in a second
    sliders: tuple[Slider, ...] = ()
    slider_network: SliderNetwork | None = None
    bone_limits: BoneLimits | None = None
    materials: tuple[Material, ...] = ()
    attach_joint: str | None = None  # path of the body joint that the root joints hang under
    person: str | None = None  # the pose that is the person, where bone coefficients made it; None: the sliders' values
    person_basis: PersonBasis | None = None  # of the modes of its sliders, and of its section
    attribution: str = ""  # copyright and license line that stays with the face
    vrm: Mapping[str, object] = field(default_factory=dict)  # what a VRM says of its avatar, as JSON: names, no indices
    photos: tuple[PhotoView, ...] = ()
    recipe: Recipe | None = None

    @property
    def point_count(self) -> int:
        """Points of all meshes."""
        return sum(len(mesh.points) for mesh in self.meshes)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of its blendshapes, each once, in the order of the meshes."""
        return tuple(dict.fromkeys(shape.name for mesh in self.meshes for shape in mesh.blendshapes))

    @property
    def variants(self) -> tuple[str, ...]:
        """Names of the variants that show other materials, each once; none for most faces."""
        return tuple(dict.fromkeys(variant for material in self.materials for variant in material.variants))

    @property
    def gltf_axes(self) -> FloatArray:
        """(4, 4) from the world of the stage to that of glTF: metres, Y up."""
        unit = self.meters_per_unit
        axes = np.diag([unit, unit, unit, 1.0])
        if self.up_axis == "Z":
            axes[1:3, 1:3] = [[0.0, unit], [-unit, 0.0]]
        return axes

    def placed(self, matrix: FloatArray) -> FaceParts:
        """The face elsewhere in its world, moved by (4, 4): only the transforms of meshes and skeleton change."""
        return replace(
            self,
            meshes=tuple(replace(mesh, transform=matrix @ mesh.transform) for mesh in self.meshes),
            skeleton=replace(self.skeleton, transform=matrix @ self.skeleton.transform),
        )


class HasParts(Protocol):
    """What exporters need of a face; `facepipe.stage.Face` has it."""

    def parts(self) -> FaceParts:
        """The face as arrays."""


@runtime_checkable
class HasLevels(HasParts, Protocol):
    """A face that may have lower levels of detail, as exporters take it; `facepipe.stage.Face` is one."""

    def lower_levels(self) -> tuple[FaceParts, ...]:
        """The face at each lower level, finest first."""


@dataclass(frozen=True)
class HeldFace:
    """Parts, as exporters take a face."""

    held: FaceParts

    def parts(self) -> FaceParts:
        """The face as arrays."""
        return self.held


@dataclass(frozen=True)
class HeldLevels(HeldFace):
    """Parts with those of lower levels."""

    lower: tuple[FaceParts, ...]

    def lower_levels(self) -> tuple[FaceParts, ...]:
        """The face at each lower level, finest first."""
        return self.lower

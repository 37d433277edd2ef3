"""What a network for first guesses is trained on: heads with landmarks, of photos or rendered with known parameters.

They are varied as the world varies them: noisy landmarks, other lights and cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.arrays import ByteArray, FloatArray
from facepipe.geometry.face_crops import face_crop, to_crop
from facepipe.geometry.landmarks import eye_distance
from facepipe.networks.files import sample_crop
from facepipe.photo.amortised.network import MEAN, SIZE, STD
from facepipe.photo.descent.fit import pose_space
from facepipe.photo.descent.joint_loss import single
from facepipe.photo.descent.landmark_rig import LandmarkRig
from facepipe.photo.descent.shadows import shadows_of_lamp
from facepipe.photo.descent.subject import FOCAL, PoseSpace, Subject
from facepipe.photo.descent.working_photo import WorkingPhoto, to_linear, to_srgb
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import KeyLight, ambient, distant

_SMALL = 1e-12
_GAIN, _CAST, _SHADE, _NOISE = 0.2, 0.07, 0.25, 0.02  # standard deviations; all but noise of logarithms
_CELLS = 4  # a side of the picture that shades
HEAD = 160  # pixels a side, about, at which heads are seen
MOVED = (0.3, 0.9)  # share of the sliders that are not at their default
NEUTRAL, MOST_SHAPES, STRONGEST = 0.25, 6, 0.85  # people without expression, shapes of an expression, weights
BOTH_SIDES = 0.7  # expressions whose left and right go together
TURN = np.radians((13.0, 20.0, 8.0))  # standard deviations of pitch, yaw and roll; at most twice that
SHARE = (0.85, 1.15)  # of the side of the picture that a head with its neck has
OFF = 0.1  # sides of the picture that a face is off its middle at most
LENS_SPREAD = 0.4  # of the logarithm of the focal length
DIM, BRIGHT = 0.12, 1.1  # white in the ambient light, and in a lamp's


@dataclass(frozen=True, kw_only=True)
class CropSpace:
    """How poses relative to crops and those of their photo belong together; in torch, with gradients.

    Leading dimensions are a batch: of poses, or of crops of one photo with a pose each.
    """

    space: PoseSpace
    crop: FloatArray  # (..., 2, 3) from crop pixels to photo pixels
    side: int  # pixels a side of the crop
    up_axis: str  # of the face: Y or Z

    def to_photo(self, relative: Tensor) -> Tensor:
        """(..., 7) as `PoseSpace` of (..., 7) relative to the crop."""
        matrix = relative.new_tensor(self.crop)
        place = (matrix[..., :2] @ relative[..., 3:5, None])[..., 0] * self.side + matrix[..., 2]
        place = place / self.space.side
        scale = relative[..., 5] + self._log_scale(relative)
        sight = self._sight(place, scale + relative[..., 6])
        turn = _product(_product(sight, self._tilt(relative)), _from_vector(relative[..., :3]))
        rotation = _to_vector(_product(turn, self._front(relative)))
        return torch.cat([rotation, place, scale[..., None], relative[..., 6:]], dim=-1)

    def to_crop(self, pose: Tensor) -> Tensor:
        """(..., 7) relative to the crop of (..., 7) as `PoseSpace`."""
        matrix = pose.new_tensor(self.crop)
        sight = self._sight(pose[..., 3:5], pose[..., 5] + pose[..., 6])
        before = _inverse(_product(sight, self._tilt(pose)))
        turn = _product(_product(before, _from_vector(pose[..., :3])), _inverse(self._front(pose)))
        off = pose[..., 3:5] * self.space.side - matrix[..., 2]
        place = (torch.linalg.inv(matrix[..., :2]) @ off[..., None])[..., 0] / self.side
        size = pose[..., 5] - self._log_scale(pose)
        return torch.cat([_to_vector(turn), place, size[..., None], pose[..., 6:]], dim=-1)

    def _log_scale(self, like: Tensor) -> Tensor:
        """(...) logarithm of the crop's side in sides of the photo."""
        scale = np.hypot(self.crop[..., 0, 0], self.crop[..., 1, 0])
        return like.new_tensor(np.log(scale * self.side / self.space.side))

    def _tilt(self, like: Tensor) -> Tensor:
        """(..., 4) the crop's turn in the picture, whose y points down, about the view."""
        half = -np.arctan2(self.crop[..., 1, 0], self.crop[..., 0, 0]) / 2
        return like.new_tensor(np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1))

    def _front(self, like: Tensor) -> Tensor:
        """(4,) the turn that makes a face look at the viewer upright."""
        half = np.sqrt(0.5)
        return like.new_tensor([half, -half, 0.0, 0.0] if self.up_axis == "Z" else [1.0, 0.0, 0.0, 0.0])

    def _sight(self, place: Tensor, log_focal: Tensor) -> Tensor:
        """(..., 4) the turn from straight ahead to a place in the photo."""
        center = place.new_tensor(self.space.center) / self.space.side
        x, y = ((place - center) / log_focal.exp()[..., None]).unbind(-1)
        length = (x * x + y * y + 1).sqrt()
        half = torch.stack([length + 1, -y, -x, torch.zeros_like(x)], dim=-1)
        return half / torch.linalg.vector_norm(half, dim=-1, keepdim=True)


def _from_vector(vector: Tensor) -> Tensor:
    """(..., 4) unit quaternions, w first, of rotation vectors (..., 3), smooth at 0."""
    square = (vector * vector).sum(dim=-1, keepdim=True)
    small = square < 1e-6
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    share = torch.where(small, 0.5 - square / 48, (angle / 2).sin() / angle)
    real = torch.where(small, 1 - square / 8, (angle / 2).cos())
    return torch.cat([real, vector * share], dim=-1)


def _to_vector(quaternion: Tensor) -> Tensor:
    """(..., 3) rotation vectors up to pi of unit quaternions."""
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    real, vector = quaternion[..., :1], quaternion[..., 1:]
    square = (vector * vector).sum(dim=-1, keepdim=True)
    small = square < 1e-8
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    share = torch.where(small, 2 / real.clamp(min=_SMALL), 2 * torch.atan2(sine, real) / sine)
    return vector * share


def _product(one: Tensor, other: Tensor) -> Tensor:
    """Quaternions multiplied: the turn `other`, then `one`."""
    a, b, c, d = one.unbind(-1)
    w, x, y, z = other.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )


def _inverse(quaternion: Tensor) -> Tensor:
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)


def noisy_landmarks(landmarks: FloatArray, sigma: float, rng: np.random.Generator) -> FloatArray:
    """(68, 2) with noise of up to `sigma`, a share of the distance of the outer eye corners."""
    spread = sigma * rng.uniform(0, 1) * max(eye_distance(landmarks), 1.0)
    return np.asarray(landmarks + spread * rng.standard_normal(landmarks.shape))


def batch(crops: Sequence[Crop]) -> tuple[Tensor, Tensor]:
    """What the network takes."""
    return torch.stack([crop.image for crop in crops]), torch.stack([crop.landmarks for crop in crops])


def varied(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Crops (b, 3, s, s) as the network takes them, in other light and with noise."""
    count = len(images)
    gain = rng.normal(0, _GAIN, (count, 1, 1, 1)) + rng.normal(0, _CAST, (count, 3, 1, 1))
    shade = rng.normal(0, _SHADE, (count, 1, _CELLS, _CELLS)) * rng.random((count, 1, 1, 1))
    factor = functional.interpolate(_float(shade), images.shape[2:], mode="bicubic", align_corners=False)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    strength = _float(_NOISE * rng.random((count, 1, 1, 1)))
    light = (images * STD + MEAN) * (factor + _float(gain)).exp() + strength * noise
    return (light.clamp(0, 1) - MEAN) / STD


def _float(values: FloatArray) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The parameters of a render, and its lamp."""

    shares: FloatArray  # (f,)
    expressions: FloatArray  # (e,)
    pose: FloatArray  # (7,) as `PoseSpace`
    lamp: Tensor  # (8,) as `KeyLight`


@dataclass(frozen=True, kw_only=True)
class Picture:
    """The head in a photo, in few bytes."""

    pixels: ByteArray  # (h, w, 3) sRGB
    left: int  # as `WorkingPhoto`
    top: int
    step: int
    landmarks: FloatArray  # (68, 2) pixels of the photo
    space: PoseSpace
    truth: Truth | None = None

    @classmethod
    def from_photo(cls, photo: FloatArray, landmarks: FloatArray, space: PoseSpace) -> Picture:
        """The head around the landmarks in a photo (h, w, 3) sRGB 0..1."""
        seen = WorkingPhoto.from_photo(photo, landmarks, HEAD)
        pixels = np.round(seen.pixels.numpy() * 255).astype(np.uint8)
        return cls(pixels=pixels, left=seen.left, top=seen.top, step=seen.step, landmarks=landmarks, space=space)

    def working(self) -> WorkingPhoto:
        """As the joint loss compares it."""
        pixels = torch.as_tensor(self.pixels, dtype=torch.float32) / 255
        place = {"left": self.left, "top": self.top, "step": self.step}
        return WorkingPhoto(pixels=pixels, linear=to_linear(pixels), face=torch.ones(pixels.shape[:2]), **place)

    def crop(self, landmarks: FloatArray) -> Crop:
        """The crop by landmarks (68, 2) in pixels of the photo.

        :raises InputError: as `face_crop`
        """
        matrix = face_crop(landmarks, SIZE)
        window = matrix - np.array([[0, 0, self.left], [0, 0, self.top]])
        pixels = torch.as_tensor(self.pixels, dtype=torch.float32) / 255
        image = (sample_crop(pixels, window / self.step, SIZE)[0] - MEAN) / STD
        shares = torch.as_tensor(to_crop(landmarks, matrix) / SIZE, dtype=torch.float32)
        return Crop(image=image, landmarks=shares, matrix=matrix)


@dataclass(frozen=True, kw_only=True)
class Crop:
    """What the network is given of a picture, and where that lies."""

    image: Tensor  # (3, 128, 128) as the network takes it
    landmarks: Tensor  # (68, 2) sides of the crop
    matrix: FloatArray  # (2, 3) from crop pixels to photo pixels

    def space(self, photo: PoseSpace, up_axis: str) -> CropSpace:
        """Of poses relative to this crop."""
        return CropSpace(space=photo, crop=self.matrix, side=SIZE, up_axis=up_axis)


@dataclass(frozen=True, kw_only=True)
class People:
    """Parameters of n people."""

    shares: FloatArray  # (n, f)
    expressions: FloatArray  # (n, e)
    poses: FloatArray  # (n, 7) as `PoseSpace`


def random_people(subject: Subject, space: PoseSpace, count: int, rng: np.random.Generator) -> People:
    """So many people, one a picture of that space."""
    default = subject.default_shares
    moved = rng.random((count, len(default))) < rng.uniform(*MOVED, (count, 1))
    shares = np.where(moved, rng.random(moved.shape), default)
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    other = {i: shapes.index(_mirrored(one)) for i, one in enumerate(shapes) if _mirrored(one) in shapes}
    expressions = np.zeros((count, len(shapes)))
    for weights in expressions:
        if not shapes or rng.random() < NEUTRAL:
            continue
        for shape in rng.permutation(len(shapes))[: rng.integers(1, MOST_SHAPES + 1)]:
            weights[shape] = rng.uniform(0.05, STRONGEST)
            if shape in other and rng.random() < BOTH_SIDES:
                weights[other[int(shape)]] = min(weights[shape] * rng.uniform(0.85, 1.15), STRONGEST)
    share = rng.uniform(*SHARE, (count, 1))
    log_focal = np.log(FOCAL) + LENS_SPREAD * rng.standard_normal((count, 1))
    turn = TURN * rng.standard_normal((count, 3)).clip(-2, 2)
    place = 0.5 + rng.uniform(-OFF, OFF, (count, 2))
    relative = np.concatenate([turn, place, np.log(share), log_focal - np.log(share)], axis=1)
    whole = CropSpace(space=space, crop=np.eye(2, 3), side=round(space.side), up_axis=subject.parts.up_axis)
    poses = np.asarray(whole.to_photo(torch.as_tensor(relative)).numpy())
    return People(shares=shares, expressions=expressions, poses=poses)


def _mirrored(name: str) -> str:
    """The name of the other side's shape; of others nothing that is one."""
    for one, other in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(one):
            return name.removesuffix(one) + other
    return ""


class Portraits:
    """Draws people, and photographs them."""

    def __init__(self, subject: Subject, model: FaceModel, landmarks: LandmarkRig) -> None:
        self.subject, self.model, self.landmarks = subject, model, landmarks
        self.space = pose_space(subject, HEAD, HEAD)

    def picture(self, rng: np.random.Generator) -> Picture:
        """Somebody, somewhere."""
        person = random_people(self.subject, self.space, 1, rng)
        # (8,) as `KeyLight`: a lamp before the face
        color = rng.uniform(0.3, BRIGHT) * rng.uniform(0.8, 1.2, 3)
        shine, exponent = rng.uniform(0.2, 1.2), rng.uniform(2.0, 4.5)
        lamp = torch.as_tensor(np.array([*_way(rng, 75), *color, shine, exponent]), dtype=torch.float32)
        truth = Truth(shares=person.shares[0], expressions=person.expressions[0], pose=person.poses[0], lamp=lamp)
        sliders = torch.as_tensor(self.subject.slider_values(truth.shares), dtype=torch.float32)
        weights = torch.as_tensor(self.subject.shape_weights(truth.expressions), dtype=torch.float32)
        camera = single(self.space.camera(torch.as_tensor(truth.pose)))
        with torch.no_grad():
            points = self.model.rig(sliders, weights)
            arriving = shadows_of_lamp(self.model, points, camera, lamp)
            light, background = random_light(rng), random_background(rng)
            # (materials, 3): dark to light, warm to cold, and each material a little apart
            materials = len(self.model.colors.names)
            common = np.exp(rng.uniform(-1.5, 0.3) + rng.normal(0, 0.12, 3))
            own = np.exp(rng.normal(0, 0.5, (materials, 1)) + rng.normal(0, 0.1, (materials, 3)))
            look = Look(
                camera=camera,
                light=light,
                key=KeyLight(numbers=lamp, arriving=arriving),
                background=background,
                tint=torch.as_tensor((common * own).clip(0.02, 3.0), dtype=torch.float32),
            )
            image = to_srgb(self.model.image(points, look, height=HEAD, width=HEAD)[..., :3])
        return Picture(
            pixels=(image * 255).round().to(torch.uint8).numpy(),
            left=0,
            top=0,
            step=1,
            landmarks=self.marks(person)[0],
            space=self.space,
            truth=truth,
        )

    def marks(self, people: People) -> FloatArray:
        """(n, 68, 2) where their landmarks are."""
        with torch.no_grad():
            sliders = torch.as_tensor(self.subject.slider_values(people.shares))
            weights = torch.as_tensor(self.subject.shape_weights(people.expressions))
            points = self.landmarks.rig(sliders, weights)
            marks, _ = self.landmarks.landmarks(points, self.space.camera(torch.as_tensor(people.poses)))
        return np.asarray(marks.numpy())


def random_light(rng: np.random.Generator) -> Tensor:
    """(9, 3) spherical harmonics of a dim room with up to two lamps from anywhere."""
    light = ambient(torch.as_tensor(rng.uniform(DIM, 0.5) * rng.uniform(0.85, 1.15, 3), dtype=torch.float32))
    for _ in range(rng.integers(0, 3)):
        way, color = _way(rng, 170), rng.uniform(0.05, 0.5) * rng.uniform(0.8, 1.2, 3)
        light = light + distant(*(torch.as_tensor(one, dtype=torch.float32) for one in (way, color)))
    return light


def _way(rng: np.random.Generator, around: float) -> FloatArray:
    """(3,) unit, to a lamp up to this many degrees to a side of the camera, mostly above it."""
    turn, up = np.radians(rng.uniform(-around, around)), np.radians(rng.uniform(-15, 60))
    return np.array([np.sin(turn) * np.cos(up), np.sin(up), np.cos(turn) * np.cos(up)])


def random_background(rng: np.random.Generator) -> Tensor:
    """(HEAD, HEAD, 3) linear: plain, blotted, or with rectangles too."""
    color = rng.uniform(0.02, 0.8) * rng.uniform(0.7, 1.3, 3)
    image = torch.as_tensor(color, dtype=torch.float32).expand(HEAD, HEAD, 3).clone()
    if rng.random() < 0.7:
        for cells, strength in ((3, 0.5), (12, 0.25)):
            noise = torch.as_tensor(rng.normal(0, strength, (1, 3, cells, cells)), dtype=torch.float32)
            noise = functional.interpolate(noise, (HEAD, HEAD), mode="bilinear", align_corners=False)
            image = image * noise[0].permute(1, 2, 0).exp()
    for _ in range(rng.integers(0, 6) if rng.random() < 0.4 else 0):
        top, left = rng.integers(0, HEAD, 2)
        height, width = rng.integers(HEAD // 16, HEAD // 2, 2)
        image[top : top + height, left : left + width] = torch.as_tensor(rng.uniform(0.01, 0.9, 3), dtype=torch.float32)
    return image.clamp(0, 1)

"""The shipped networks: crops of pictures for them, where they are, sessions of onnxruntime, and what they see.

That is many landmarks of a face, and where a photo shows nothing but a face, and where hair.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import face_crop, from_crop, plain_crop, to_crop, turned_crop
from facepipe.geometry.landmarks import MIRRORED
from facepipe.networks.onnx_file import PROPERTY, onnx_session, read_model

if TYPE_CHECKING:
    from facepipe.rig.torch import torch

_WIDE, _NEAR = 2.0, 1.0  # sides of crops in those of `face_crop`: a head with its hair, and a face
_INSIDE, _KNOWN = slice(17, None), 0.25  # landmarks inside the face, and the least mean share of face at them
_FADE = 0.1  # of a near crop's side, over which it takes over from the wide one
_OPERATORS = ("Sigmoid", "Gemm", "Flatten", "GlobalAveragePool")  # from presence back to the features
_BATCH = 32
COUNT, PUPILS = 68, 2
# Crops that landmarks are the mean of, each as it is and mirrored: turn in radians, scale.
_LOOKS = ((0.0, 1.0), (0.08, 1.05), (-0.08, 0.96))
_ROUNDS = 2


def sample_crop(image: torch.Tensor, matrix: FloatArray, size: int) -> torch.Tensor:
    """(1, 3, size, size) the crop of an image (h, w, 3), bilinear, with gradients to the image.

    An image of more than 1.5 times the crop's resolution is averaged over whole pixels first, so that nothing
    flickers. What lies outside the image has the colour of its nearest border pixel.

    :param matrix: (2, 3) from crop pixels to image pixels
    """
    from facepipe.rig.torch import torch

    pixels = image.permute(2, 0, 1)[None]
    factor = max(1, round(float(np.hypot(*matrix[:, 0]))))
    if factor > 1:
        pixels = torch.nn.functional.avg_pool2d(pixels, factor, ceil_mode=True, count_include_pad=False)
    centres = np.arange(size) + 0.5
    x, y = np.meshgrid(centres, centres)
    places = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.asarray(matrix).T / factor
    grid = 2 * places / (pixels.shape[3], pixels.shape[2]) - 1
    return torch.nn.functional.grid_sample(
        pixels, torch.as_tensor(grid[None], dtype=image.dtype, device=image.device), "bilinear", "border", False
    )


def presence_map(model: Any) -> tuple[bytes, int]:
    """An ONNX model of presence before its sigmoid (1, 1, r, c), and the pixels between its windows.

    :param model: the `onnx.ModelProto` of a landmark network; of its input (b, 3, S, S) the map takes (1, 3, h, w), at
        least S and multiples of the pixels between windows
    :raises ValueError: its presence is not the sigmoid of a layer of mean features
    """
    from onnx import ModelProto, TensorProto, helper, shape_inference

    made = {output: node for node in model.graph.node for output in node.output}
    steps, name = [], "presence"
    for operator in _OPERATORS:
        if name not in made or made[name].op_type != operator:
            raise ValueError(f"{name} is not of {operator}")
        steps.append(made[name])
        name = steps[-1].input[0]
    _, weight, bias = steps[1].input
    shapes = {one.name: one for one in shape_inference.infer_shapes(model).graph.value_info}
    window = shapes[name].type.tensor_type.shape.dim[2].dim_value
    size = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value
    if window < 1 or size % window:
        raise ValueError(f"features of {window} rows, of a crop of {size}")
    result = ModelProto()
    result.CopyFrom(model)
    graph = result.graph
    kernel = next((one for one in graph.initializer if one.name == weight), None)
    if kernel is None:
        raise ValueError(f"{weight} is no constant")
    kernel.dims[:] = [1, math.prod(kernel.dims), 1, 1]
    # the nodes that make `name`
    wanted, nodes = {name}, []
    for node in reversed(model.graph.node):
        if wanted & set(node.output):
            wanted |= set(node.input)
            nodes.append(node)
    nodes = nodes[::-1]
    nodes.append(helper.make_node("AveragePool", [name], ["mean"], kernel_shape=[window, window]))
    nodes.append(helper.make_node("Conv", ["mean", weight, bias], ["map"]))
    del graph.node[:], graph.output[:]
    graph.node.extend(nodes)
    graph.output.append(helper.make_tensor_value_info("map", TensorProto.FLOAT, None))
    for axis, length in zip(graph.input[0].type.tensor_type.shape.dim[2:], ("height", "width"), strict=True):
        axis.dim_param = length
    return result.SerializeToString(), size // window


def landmarks_by_looks(
    network: LandmarkSession | DenseLandmarkSession, photo: Float32Array, matrices: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """(2 k, n, 2) landmarks in a photo by k crops (2, 3) as they are, then mirrored, and what else is said of each."""
    crops = crops_of(photo, matrices, network.size)
    places, further = network(np.concatenate([crops, crops[..., ::-1]]))
    places[len(crops) :] = [network.size, 0] + places[len(crops) :, network.mirrored] * [-1, 1]
    return np.array([from_crop(one, matrix) for one, matrix in zip(places, matrices * 2, strict=True)]), further


def crops_of(photo: Float32Array, matrices: list[FloatArray], size: int) -> FloatArray:
    """(k, 3, size, size) several of `plain_crop`."""
    return np.stack([plain_crop(photo, matrix, size).transpose(2, 0, 1) for matrix in matrices])


def landmark_model() -> Path:
    """The file that finds the 68 landmarks of a face in a crop, and whether there is one."""
    return _own("landmarks.onnx")


def dense_landmark_model() -> Path:
    """The file that finds many points of the built-in head's skin in a crop of a face, and how far off they may be."""
    return _own("dense_landmarks.onnx")


def feature_model() -> Path:
    """The file that sees content, identity and attributes in a crop of a face."""
    return _own("face_features.onnx")


def _own(name: str) -> Path:
    return Path(str(files("facepipe.networks") / name))


class _CropSession:
    """An ONNX file that looks at crops of faces."""

    kind: str
    outputs: tuple[str, ...]

    def __init__(self, source: Path | bytes) -> None:
        """
        :param source: a file, or its bytes
        :raises InputError: no file, no ONNX model, one with data in other files, or one of another kind
        """
        where = "landmark network" if isinstance(source, bytes) else source
        data = source if isinstance(source, bytes) else read_model(source).SerializeToString()
        try:
            self._session = onnx_session(data)
        except Exception as error:  # onnxruntime's own classes share no other base
            raise InputError(where, f"can't be read: {str(error)[:120]}, expected an ONNX landmark network") from None
        outputs = {output.name for output in self._session.get_outputs()}
        try:
            described = json.loads(self._session.get_modelmeta().custom_metadata_map[PROPERTY])
            known = described["kind"] == self.kind and set(self.outputs) <= outputs
            self.size = int(described["size"])
            self._mean, self._std = (np.asarray(described[key], np.float32).reshape(3, 1, 1) for key in ("mean", "std"))
            self._describe(described, data)
        except (LookupError, TypeError, ValueError):
            known = False
        if not known:
            what = f"no landmark network, expected '{PROPERTY}' of kind {self.kind} and both its outputs"
            raise InputError(where, what)

    def _describe(self, described: Mapping[str, Any], data: bytes) -> None:
        """Read what else there is to know; LookupError, TypeError or ValueError where it is missing."""

    def _run(self, crops: FloatArray) -> tuple[FloatArray, ...]:
        """The outputs of sRGB crops (b, 3, S, S) in 0..1."""
        rows = []
        for start in range(0, len(crops), _BATCH):
            rows.append(self._session.run(list(self.outputs), {"image": self._scaled(crops[start : start + _BATCH])}))
        return tuple(np.concatenate(column).astype(np.float64) for column in zip(*rows, strict=True))

    def _scaled(self, pixels: FloatArray) -> FloatArray:
        return (np.asarray(pixels, np.float32) - self._mean) / self._std


class LandmarkSession(_CropSession):
    """An ONNX file of the kind ``landmarks``."""

    kind, outputs = "landmarks", ("landmarks", "presence")
    mirrored = MIRRORED
    cell: int  # pixels between the windows of a map

    def _describe(self, described: Mapping[str, Any], data: bytes) -> None:
        from onnx import load_from_string

        graph, self.cell = presence_map(load_from_string(data))
        try:
            self._map = onnx_session(graph)
        except Exception as error:  # of onnxruntime
            raise ValueError("its map can't be read") from error

    def __call__(self, crops: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Landmarks (b, 68, 2) in pixels of the crops and presence (b,) of sRGB crops (b, 3, S, S) in 0..1."""
        if not len(crops):
            return np.zeros((0, 68, 2)), np.zeros(0)
        landmarks, presence = self._run(crops)
        return landmarks * self.size, presence[:, 0]

    def presence_map(self, level: FloatArray) -> FloatArray:
        """(r, c) presence before its sigmoid in a picture's (3, h, w), of whole cells, windows as large as a crop."""
        found: FloatArray = self._map.run(None, {"image": self._scaled(level)[None]})[0][0, 0]
        return found


class DenseLandmarkSession(_CropSession):
    """An ONNX file of the kind ``dense-landmarks``."""

    kind, outputs = "dense-landmarks", ("landmarks", "errors")
    zoom: float  # of its crops beyond `face_crop`
    mirrored: list[int]  # for each landmark that of the other side

    def _describe(self, described: Mapping[str, Any], data: bytes) -> None:
        self.zoom = float(described["zoom"])
        self.mirrored = [int(row) for row in described["mirrored"]]

    def __call__(self, crops: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Landmarks (b, n, 2) and the errors to expect of them (b, n), both in pixels of crops (b, 3, S, S)."""
        landmarks, errors = self._run(crops)
        return landmarks * self.size, errors * self.size


@cache
def own_landmark_session() -> LandmarkSession:
    """The network of `landmark_model`, loaded once."""
    return LandmarkSession(landmark_model())


class MaskNetwork(_CropSession):
    """An ONNX file of the kind ``face-mask``."""

    kind, outputs = "face-mask", ("shares",)

    def __call__(self, crops: Float32Array) -> Float32Array:
        """(b, 3, s, s) shares of face, hair and all else in cells of sRGB crops (b, 3, S, S) in 0..1."""
        return self._run(crops)[0].astype(np.float32)


@cache
def own_mask_network() -> MaskNetwork:
    """The network of faces and hair, loaded once."""
    return MaskNetwork(_own("face_mask.onnx").read_bytes())


@cache
def own_dense_session() -> DenseLandmarkSession:
    """The network of `dense_landmark_model`, loaded once."""
    return DenseLandmarkSession(dense_landmark_model())


def dense_landmarks(
    network: DenseLandmarkSession, photo: Float32Array, landmarks: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """(n, 2) landmarks, the first 68 those of Multi-PIE, the last two the pupils, and errors to expect of them (n,).

    In pixels of a photo (h, w, 3) with a face about at `landmarks` (68, 2); None: no crop. After Wood et al., "3D Face
    Reconstruction with Dense Landmarks", ECCV 2022.
    """
    points = landmarks
    for _ in range(_ROUNDS):
        try:
            aligned = face_crop(points[:COUNT], network.size)
        except InputError:
            return None
        matrices = [turned_crop(aligned, turn, scale / network.zoom, network.size) for turn, scale in _LOOKS]
        looks, errors = landmarks_by_looks(network, photo, matrices)
        errors[len(matrices) :] = errors[len(matrices) :, network.mirrored]
        points = looks.mean(axis=0)
    spread = ((looks - points) ** 2).sum(axis=2).mean(axis=0)
    scales = np.array([np.hypot(*matrix[:, 0]) for matrix in matrices * 2])
    return points, np.sqrt(((errors * scales[:, None]) ** 2).mean(axis=0) + spread)


@dataclass(frozen=True, kw_only=True)
class FaceMask:
    """Shares of a photo's pixels, 0..1; beyond the head both are 0."""

    face: Float32Array  # (h, w) skin, eyes and mouth, ears and neck
    hair: Float32Array  # (h, w)


def face_mask(photo: Float32Array, landmarks: FloatArray) -> FaceMask:
    """Where a photo (h, w, 3) of sRGB 0..1 shows face and hair at landmarks (68, 2): from far, and the face from near.

    Where hardly any of the landmarks inside the face lie on what the network takes for face, it does not know such
    faces: all is face then.

    :raises InputError: landmarks that are nothing like a face's
    """
    network = own_mask_network()
    shares = np.zeros((2, *photo.shape[:2]), np.float32)
    aligned = face_crop(landmarks, network.size)
    for scale in (_WIDE, _NEAR):
        matrix = turned_crop(aligned, 0.0, scale, network.size)
        crop = plain_crop(photo, matrix, network.size).transpose(2, 0, 1)
        seen, mirrored = network(np.stack([crop, crop[..., ::-1]]))[:, :2]
        shown = (seen + mirrored[..., ::-1]) / 2
        # what the crop shows goes over what was there, fading in from the crop's border
        size = network.size
        height, width = shares.shape[1:]
        corners = np.array([(0, 0), (size, 0), (0, size), (size, size)]) @ matrix[:, :2].T + matrix[:, 2]
        left, top = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, (width, height))
        right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int), 0, (width, height))
        places = np.stack(np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5), axis=-1)
        inside = to_crop(places, matrix) / size  # 0..1 of the crop
        border = np.minimum(inside, 1 - inside).min(axis=-1)
        amount = np.clip(border / _FADE, 0, 1).astype(np.float32)
        at = np.moveaxis(inside[..., ::-1], -1, 0) * shown.shape[1] - 0.5
        window = shares[:, top:bottom, left:right]
        for one, channel in zip(window, shown, strict=True):
            one += amount * (map_coordinates(channel, at, order=1, mode="nearest") - one)
    column, row = np.clip(landmarks[_INSIDE], 0, np.array(photo.shape[1::-1]) - 1).astype(np.int64).T
    if shares[0, row, column].mean() < _KNOWN:
        return FaceMask(face=np.ones_like(shares[0]), hair=np.zeros_like(shares[1]))
    return FaceMask(face=shares[0], hair=shares[1])

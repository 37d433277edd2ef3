"""Shards of random heads as arrays for the feature network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from features_network import SIZE
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import face_crop, to_crop

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

OUTSIDE = -1  # the class of what a picture does not show
_MARKS = 68


@dataclass(frozen=True, kw_only=True)
class Heads:
    """Pictures of heads, and where in them the faces' crops are."""

    images: npt.NDArray[np.uint8]  # (n, s, s, 3) sRGB
    labels: npt.NDArray[np.uint8]  # (n, s, s) classes
    crops: FloatArray  # (n, 2, 3) from the crop to the picture, both -1..1
    marks: FloatArray  # (n, 68, 2) landmarks, -1..1 of the crop
    identities: IntArray  # (n,) which person
    sources: IntArray  # (n,) which kind of head
    attributes: FloatArray  # (n, a) 0..1, NaN where the head has no such slider
    shapes: FloatArray  # (n, 204) the person's neutral landmarks; NaN where pictures of a person share their look
    names: tuple[str, ...]  # of the attributes

    def __len__(self) -> int:
        return len(self.images)

    @property
    def changing(self) -> npt.NDArray[np.bool_]:
        """(n,) whether the person has another look in each picture."""
        return np.isfinite(self.shapes[:, 0])

    def cropped(self, rows: IntArray, size: int, beside: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """sRGB 0..1 (b, 3, 128, 128) and classes (b, size, size), `OUTSIDE` where a picture ends.

        :param beside: (b, 2, 3) from the crops wanted to those that the landmarks ask for, both -1..1
        """
        matrices = torch.as_tensor(self.crops[rows], dtype=torch.float32)
        if beside is not None:
            turned = matrices[:, :, :2] @ beside
            matrices = turned + torch.nn.functional.pad(matrices[:, :, 2:], (2, 0))
        images = torch.as_tensor(self.images[rows]).permute(0, 3, 1, 2).float() / 255
        labels = torch.as_tensor(self.labels[rows])[:, None].float() + 1
        grids = [affine_grid(matrices, [len(rows), 1, side, side], align_corners=False) for side in (SIZE, size)]
        shown = grid_sample(images, grids[0], "bilinear", "border", False)
        classes = grid_sample(labels, grids[1], "nearest", "zeros", False)[:, 0].long() - 1
        return shown, classes

    def take(self, rows: IntArray) -> Heads:
        """Some of the pictures."""
        arrays = {field.name: getattr(self, field.name)[rows] for field in fields(self) if field.name != "names"}
        return replace(self, **arrays)


def read(folders: Iterable[Path]) -> Heads:
    """All pictures of faces in folders of shards, in the order of their names.

    :raises InputError: no shards, or shards of different attributes
    """
    paths = [path for folder in folders for path in sorted(folder.glob("[!.]*.npz"))]
    if not paths:
        raise InputError("shards", "no .npz files in the folders, expected some of training/heads.py")
    whole = joined([_shard(path) for path in paths])
    kept = np.isfinite(whole.attributes).any(axis=0)  # sliders of expressions are never known
    return replace(whole, attributes=whole.attributes[:, kept], names=tuple(np.array(whole.names)[kept].tolist()))


def joined(parts: Sequence[Heads]) -> Heads:
    """All of them.

    :raises InputError: with different attributes
    """
    if len({part.names for part in parts}) > 1:
        raise InputError("shards", "made with different sliders, expected one version of facepipe")
    names = [field.name for field in fields(Heads) if field.name != "names"]
    return Heads(names=parts[0].names, **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _shard(path: Path) -> Heads:
    with np.load(path) as data:
        rows = np.flatnonzero((data["presence"] == 1) & np.isfinite(data["landmarks"]).all(axis=(1, 2)))
        size, landmarks = data["image"].shape[1], data["landmarks"][rows]
        shapes = data["neutral"].reshape(-1, 3 * _MARKS) if "neutral" in data else None
        return Heads(
            images=data["image"][rows],
            labels=data["label"][rows],
            crops=np.stack([_unit_crop(marks, size) for marks in landmarks]),
            marks=np.stack([to_crop(marks, face_crop(marks, 2)) - 1 for marks in landmarks]).astype(np.float32),
            identities=data["identity"][rows].astype(np.int64),
            sources=data["source"][rows].astype(np.int64),
            attributes=np.where(data["attribute_mask"], data["attributes"], np.nan)[rows].astype(np.float32),
            shapes=np.full((len(rows), 3 * _MARKS), np.nan, np.float32) if shapes is None else shapes[rows],
            names=tuple(str(name) for name in data["attribute_names"]),
        )


def _unit_crop(landmarks: FloatArray, size: int) -> FloatArray:
    """(2, 3) `face_crop` between coordinates -1..1 of the crop and of a picture `size` pixels a side."""
    matrix = face_crop(landmarks, SIZE)
    linear = matrix[:, :2] * (SIZE / size)
    return np.column_stack([linear, linear.sum(axis=1) + matrix[:, 2] * 2 / size - 1]).astype(np.float32)


def split(heads: Heads, share: float, random: np.random.Generator) -> tuple[Heads, Heads]:
    """Training and held-out heads: no person is in both."""
    identities = np.unique(heads.identities)
    held_out = random.permutation(identities)[: max(2, round(share * len(identities)))]
    chosen = np.isin(heads.identities, held_out)
    return heads.take(np.flatnonzero(~chosen)), heads.take(np.flatnonzero(chosen))

"""Small made-up faces to fit to scans: a dome with landmarks, an eyeball, joints and shapes; people of a few kinds."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from faces import with_meshes
from solids import ball

from facepipe.geometry.polygons import point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.parts import Animation, Blendshape, FaceParts, Inbetween, Landmarks, Mesh, Skeleton, Skin, Slider
from facepipe.scanning.database import FaceDatabase, create_database
from facepipe.scans import Scan, ScanLandmarks
from facepipe.verbs.whole_faces import WholeFace, whole_face

POSE = Similarity(
    rotation=np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]]),
    translation=np.array([40.0, -3.0, 9.0]),
    scale=0.1,
)
_SIDE = 31  # points of the grid
_EYE = np.array([1.5, 1.2, 2.0])  # cm


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """(side^2, 2) places over 100 x 100 mm and triangles that face +Z."""
    x, y = np.meshgrid(*[np.linspace(-50.0, 50.0, side)] * 2, indexing="ij")
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([x, y], axis=-1).reshape(-1, 2), triangles


def dome(places: np.ndarray, seed: int) -> np.ndarray:
    """(n, 3) millimetres of a person's face over (n, 2) places; person 0 is the plainest."""
    x, y = places.T
    ways = np.random.default_rng([seed, 5]).normal(size=4) if seed else np.zeros(4)
    z = 40.0 * np.exp(-(x**2 + 1.4 * y**2) / 1500.0) + 6.0 * np.exp(-((x - 18) ** 2 + (y + 10) ** 2) / 60.0)
    z += 2.0 * ways[0] * np.exp(-((x - 20) ** 2 + y**2) / 600.0) + 2.0 * ways[1] * np.exp(
        -((x + 15) ** 2 + y**2) / 600.0
    )
    return np.stack([x * (1 + 0.03 * ways[2]), y * (1 + 0.03 * ways[3]), z], axis=1)


def landmark_places() -> np.ndarray:
    """(68, 2) multipie68 over the dome."""
    jaw = [(35 * np.cos(turn), -4 + 32 * np.sin(turn)) for turn in np.linspace(np.pi, 2 * np.pi, 17)]
    brows = [(side * x, 24.0) for side, xs in ((-1, (28, 23, 18, 13, 8)), (1, (8, 13, 18, 23, 28))) for x in xs]
    nose = [(0.0, y) for y in (14.0, 9.0, 4.0, -1.0)] + [(float(x), -6.0) for x in (-8, -4, 0, 4, 8)]
    eyes = [
        (middle + 7 * np.cos(turn), 13 + 5 * np.sin(turn))
        for middle in (-17, 17)
        for turn in np.pi * (1 - np.arange(6) / 3)
    ]
    mouth = [(12 * np.cos(turn), -19 + 6 * np.sin(turn)) for turn in np.pi * (1 - np.arange(12) / 6)]
    inner = [(8 * np.cos(turn), -19 + 3 * np.sin(turn)) for turn in np.pi * (1 - np.arange(8) / 4)]
    return np.array([*jaw, *brows, *nose, *eyes, *mouth, *inner])


def face(seed: int = 0) -> FaceParts:
    """A person as a rigged stage in centimetres: a dome and an eyeball, normals, two shapes, a clip and a slider."""
    places, triangles = grid(_SIDE)
    points, (eye, eye_triangles) = 0.1 * dome(places, seed), ball(6, 1.0)
    eye = eye + _EYE
    lower = 1.0 / (1.0 + np.exp((places[:, 1] + 12.0) / 4.0))
    skin = Skin(
        joint_indices=np.tile(np.arange(2, dtype=np.int32), (len(points), 1)),
        joint_weights=np.stack([1.0 - lower, lower], axis=1),
    )
    marks = [int(np.linalg.norm(places - landmark_place, axis=1).argmin()) for landmark_place in landmark_places()]
    head = replace(
        _mesh("Head", points, triangles),
        normals=point_normals(points, triangles),
        skin=skin,
        blendshapes=(_opening(points, triangles, lower), _shape("smile", 0.2 * np.roll(points, 1, axis=1), places)),
        landmarks={"multipie68": Landmarks(indices=np.array(marks, np.int32))},
        regions={"all": np.ones(len(points), np.float32)},
    )
    rigid = Skin(joint_indices=np.full((len(eye), 1), 2, np.int32), joint_weights=np.ones((len(eye), 1)))
    ball_mesh = replace(_mesh("Eye", eye, eye_triangles), skin=rigid)
    corner_normals = point_normals(eye, eye_triangles)[eye_triangles.ravel()]
    return FaceParts(
        name="Dome",
        meshes=(head, replace(ball_mesh, normals=corner_normals)),
        skeleton=_skeleton(),
        animations=(_clip(),),
        sliders=(Slider(name="open", shapes=(("jawOpen", 1.0),)),),
    )


def database(seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6)) -> FaceDatabase:
    """The neutrals of some people."""
    return create_database([functools.partial(_neutral, seed) for seed in seeds]).database


def _neutral(seed: int) -> WholeFace:
    parts = face(seed)
    return whole_face(with_meshes(replace(parts, sliders=()), blendshapes=()), f"p{seed}")


def scan(seed: int, side: int = 61, pose: Similarity = POSE) -> tuple[Scan, ScanLandmarks]:
    """The dome of a person on another grid, somewhere, with its landmarks: where the template's landmarks truly are."""
    places, triangles = grid(side)
    own, _ = grid(_SIDE)
    marks = face(0).meshes[0].landmarks["multipie68"].indices
    landmarks = pose.apply(dome(own[marks], seed))
    return (
        Scan(name="scan", points=pose.apply(dome(places, seed)), triangles=triangles.astype(np.int32)),
        ScanLandmarks(points=landmarks),
    )


def _mesh(name: str, points: np.ndarray, triangles: np.ndarray) -> Mesh:
    counts = np.full(len(triangles), 3, np.int32)
    return Mesh(
        name=name, points=points, face_vertex_counts=counts, face_vertex_indices=triangles.ravel().astype(np.int32)
    )


def _opening(points: np.ndarray, triangles: np.ndarray, lower: np.ndarray) -> Blendshape:
    """jawOpen, with an inbetween and normal offsets."""
    indices = np.flatnonzero(lower > 0.02).astype(np.int32)
    offsets = lower[indices, None] * np.array([0.0, -0.6, -0.2])
    moved = points.copy()
    moved[indices] += offsets
    turned = point_normals(moved, triangles)[indices] - point_normals(points, triangles)[indices]
    between = Inbetween(name="half", weight=0.5, offsets=0.6 * offsets)
    return Blendshape(
        name="jawOpen", point_indices=indices, offsets=offsets, normal_offsets=turned, inbetweens=(between,)
    )


def _shape(name: str, offsets: np.ndarray, places: np.ndarray) -> Blendshape:
    indices = np.flatnonzero(np.abs(places).max(axis=1) < 20).astype(np.int32)
    return Blendshape(name=name, point_indices=indices, offsets=0.1 * offsets[indices])


def _skeleton() -> Skeleton:
    """The head, the jaw below it, and the eye; axes turned."""
    bind = np.stack([np.eye(4)] * 3)
    bind[1, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    bind[:, :3, 3] = [[0.0, 0.0, -2.0], [0.0, -1.5, 1.0], _EYE.tolist()]
    rest = np.stack([np.linalg.inv(bind[0]) @ one for one in bind])
    rest[0] = bind[0]
    joints = ("head", "head/jaw", "head/eye")
    return Skeleton(joints=joints, bind_transforms=bind, rest_transforms=rest)


def _clip() -> Animation:
    """Two samples: at rest, then with the jaw moved by 0.5 cm."""
    rest = _skeleton().rest_transforms
    translations = np.stack([rest[:, :3, 3], rest[:, :3, 3] + [[0, 0, 0], [0, -0.5, 0], [0, 0, 0]]])
    turns = np.array([[0, 0, 0, 1.0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], [0, 0, 0, 1.0]])
    return Animation(
        name="talk",
        times=np.array([0.0, 1.0]),
        joints=_skeleton().joints,
        translations=translations,
        rotations=np.stack([turns, turns]),
        scales=np.ones((2, 3, 3)),
    )

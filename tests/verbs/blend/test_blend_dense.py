"""The whole blend of tiny faces against dense pseudo-inverses and least squares, made without any of its solvers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blend_faces import misaligned, same
from faces import replace_mesh, tiny_face
from solvers import SOLVERS

from facepipe.parts import FaceParts, Inbetween, Mesh
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.session import Solution

WEIGHTS = Weights(regions={"mouth": (0.9, 0.1), "neck": (0.2, 0.8)}, default=(0.5, 0.5))


def tiny(seed: int) -> FaceParts:
    """A tiny face with features of its own; shapes that hold still somewhere, and not at the same points in all."""
    parts, rng = tiny_face(seed), np.random.default_rng(100 + seed)

    def one(mesh: Mesh) -> Mesh:
        kept = []
        for shape in mesh.blendshapes:
            some = np.sort(rng.permutation(len(shape.point_indices))[: max(2, len(shape.point_indices) // 2)])
            inbetweens = tuple(
                Inbetween(name=own.name, weight=own.weight, offsets=own.offsets[some]) for own in shape.inbetweens
            )
            kept.append(
                replace(
                    shape,
                    point_indices=shape.point_indices[some],
                    offsets=shape.offsets[some],
                    normal_offsets=None,
                    inbetweens=inbetweens,
                )
            )
        return replace_mesh(mesh, points=mesh.points + rng.normal(0, 0.1, mesh.points.shape), blendshapes=tuple(kept))

    return replace(parts, meshes=tuple(map(one, parts.meshes)))


def solve(solver: str, expressions: str) -> tuple[BlendSession, Solution]:
    faces = [Face.from_parts(tiny(0)), Face.from_parts(misaligned(tiny(1), mm=50.0, degrees=20.0))]
    options = BlendOptions(keep_shape="", expressions=expressions, solver=solver, contacts=False)  # type: ignore[arg-type]
    blend = BlendSession(faces, options)
    return blend, blend.solve(WEIGHTS)


class Dense:
    """Matrices of the head and of the loose teeth, edges found face by face."""

    def __init__(self, blend: BlendSession) -> None:
        self.blend, self.count = blend, blend.sources.points.shape[1]
        masks = {name: np.zeros(self.count) for name in ("mouth", "neck")}
        pairs, start = set(), 0
        for mesh in blend.sources.base.meshes:
            for quad in np.asarray(mesh.face_vertex_indices).reshape(-1, 4) + start:
                pairs |= {tuple(sorted((int(quad[i]), int(quad[i - 1])))) for i in range(4)}
            for name, mask in mesh.regions.items():
                masks[name][start : start + len(mesh.points)] = mask
            start += len(mesh.points)
        self.head = np.arange(36)
        self.loose = np.arange(36, self.count)
        self.edges = np.array(sorted(pairs))
        bridges = blend.graph.bridges
        self.bridges = np.stack([bridges.leaders, bridges.followers], axis=1)
        self.bridge_weights = bridges.weights
        for leader, follower in self.bridges:
            for mask in masks.values():
                mask[follower] = mask[leader]  # the teeth have no regions of their own
        total = sum(masks.values())
        table = {"mouth": (0.9, 0.1), "neck": (0.2, 0.8)}
        self.shares = sum(np.outer(masks[name] / total, table[name]) for name in table)

    def wanted(self, values: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Blended differences along pairs of points, of (K, n, 3) values."""
        shares = self.shares[pairs].mean(axis=1)
        return np.einsum("ek,kec->ec", shares, values[:, pairs[:, 1]] - values[:, pairs[:, 0]])

    def rows(self, pairs: np.ndarray) -> np.ndarray:
        matrix = np.zeros((len(pairs), self.count))
        matrix[np.arange(len(pairs)), pairs[:, 0]] = -1
        matrix[np.arange(len(pairs)), pairs[:, 1]] = 1
        return matrix

    def solve(self, values: np.ndarray, anchored: np.ndarray, moving: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) by M^T M x = M^T D on the head, then on the teeth with the bridges.

        :param moving: (n,) instead solve the bi-Laplacian of both with 0 at all other points
        """
        found, anchor = np.zeros((self.count, 3)), self.blend.graph.anchor
        own = self.edges[self.edges[:, 0] < 36]
        M, D = self.rows(own)[:, :36], self.wanted(values, own)
        if moving is None:
            x = np.linalg.pinv(M.T @ M) @ M.T @ D
            found[:36] = x - x[anchor] + anchored
        else:
            pinned = moving[:36].all()  # nothing else holds the head
            free = moving[:36] & ~(pinned & (np.arange(36) == anchor))
            right = M.T @ D - pinned * np.outer((M.T @ M)[:, anchor], anchored)
            found[:36][free] = np.linalg.lstsq((M.T @ M)[:, free], right, rcond=None)[0]
            found[anchor] = anchored if pinned else found[anchor]
        pairs = np.concatenate([self.edges[self.edges[:, 0] >= 36], self.bridges])
        weights = np.concatenate([np.ones(len(pairs) - len(self.bridges)), self.bridge_weights])
        M, D = self.rows(pairs), self.wanted(values, pairs)
        D = D - M[:, :36] @ found[:36]  # the teeth follow the head as it stands
        M = M[:, 36:]
        L, right = M.T @ np.diag(weights) @ M, M.T @ np.diag(weights) @ D
        if moving is None:
            found[36:] = np.linalg.pinv(L) @ right
        else:
            free = moving[36:]
            found[36:][free] = np.linalg.lstsq(L[:, free], right, rcond=None)[0]
        return found


@SOLVERS
@pytest.mark.parametrize("expressions", ["static", "document"])
def test_the_whole_blend_agrees_with_a_dense_reference(solver: str, expressions: str) -> None:
    blend, solution = solve(solver, expressions)
    dense = Dense(blend)
    np.testing.assert_array_equal(np.unique(np.sort(blend.graph.edges, axis=1), axis=0), dense.edges)
    points = blend.sources.points
    same(solution.neutral.points, dense.solve(points, points[0, 2]), 1e-9)
    assert blend.graph.anchor == 2
    partly = 0
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        full, moving = np.zeros(points.shape), np.zeros(dense.count, bool)
        full[:, sculpt.points] = sculpt.offsets
        moving[sculpt.points] = True
        anchored = dense.shares[2] @ full[:, 2]
        if expressions == "document":
            # S605': candidates from the expressions' own edges; S606': static points put back
            candidate = dense.solve(points + full, points[0, 2] + anchored)
            expected = (candidate - dense.solve(points, points[0, 2]))[sculpt.points]
        else:
            expected = dense.solve(full, anchored, moving)[sculpt.points]
        same(offsets, expected, 1e-9)
        partly += int(0 < moving[:36].sum() < 36)
    assert len(solution.sculpts) == 3
    assert partly == 3


def test_the_twice_multiplied_system_of_the_document_is_the_same_solve() -> None:
    """(M^T M)^2 x = M^T M M^T D has the very solution of M^T M x = M^T D."""
    blend, _ = solve("splu", "document")
    dense = Dense(blend)
    own = dense.edges[dense.edges[:, 0] < 36]
    M, D = dense.rows(own)[:, :36], dense.wanted(blend.sources.points, own)
    L = M.T @ M
    same(np.linalg.pinv(L @ L) @ L @ M.T @ D, np.linalg.pinv(L) @ M.T @ D, 1e-9)

"""All bones of an FBX file as one skeleton, and its skins on that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.importers.fbx.scene import NONE, SKIN_VERTEX, SKIN_WEIGHT, Rows, Scene, matrices
from facepipe.parts import Skeleton, Skin, identity
from facepipe.rig.binding import Bindings, BoundSkin, unless_flat

_ALIKE = 1e-4  # scales of joints that are one
_DUAL_QUATERNIONS, _BLENDED = 2, 3  # ufbx_skinning_method


@dataclass(frozen=True)
class Nodes:
    """All nodes of a file; a parent comes before its children."""

    names: list[str]
    parents: list[int]  # -1: the root
    meshes: list[int]  # -1: shows none
    skins: list[int]  # of that mesh the first that has clusters, -1: none
    worlds: FloatArray  # (n, 4, 4) in the axes of the face
    geometry: FloatArray  # (n, 4, 4) mesh -> node
    order: list[int]  # depth first

    @property
    def shown(self) -> list[int]:
        """Those that show a mesh, depth first."""
        return [node for node in self.order if self.meshes[node] >= 0]


def read_nodes(scene: Scene, turn: FloatArray) -> Nodes:
    """The nodes as they stand where nothing plays.

    :raises InputError: transforms that are not finite
    """
    rows = scene.tables["nodes"]
    parents = [-1 if row["parent"] == NONE else int(row["parent"]) for row in rows]
    meshes = [-1 if row["mesh"] == NONE else int(row["mesh"]) for row in rows]
    worlds, geometry = turn @ matrices(rows["world"]), matrices(rows["geometry"])
    if not (np.isfinite(worlds).all() and np.isfinite(geometry).all()):
        raise scene.error("transforms of nodes that are not finite")
    children: list[list[int]] = [[] for _ in rows]
    for node, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(node)
    order, stack = [], [node for node, parent in enumerate(parents) if parent < 0][::-1]
    while stack:
        node = stack.pop()
        order.append(node)
        stack.extend(reversed(children[node]))
    bound = scene.tables["skins"]["clusters"]["count"]
    listed = [scene.ids(row["skins"]) for row in scene.tables["meshes"]]
    of_mesh = [next((skin for skin in own if bound[skin]), -1) for own in listed]
    skins = [-1 if mesh < 0 else of_mesh[mesh] for mesh in meshes]
    return Nodes([scene.text(row["name"]) for row in rows], parents, meshes, skins, worlds, geometry, order)


def bones_of(scene: Scene, nodes: Nodes, moved: set[int]) -> tuple[set[int], set[int]]:
    """Nodes that are bones or that skins name, and those that are moved and carry meshes or bones as such do."""
    bones = {node for node, row in enumerate(scene.tables["nodes"]) if row["bone"]}
    bones |= {int(row["node"]) for row in scene.tables["clusters"] if row["node"] != NONE}
    carries = [node in bones or (mesh >= 0 and nodes.skins[node] < 0) for node, mesh in enumerate(nodes.meshes)]
    for node in reversed(nodes.order):
        if carries[node] and nodes.parents[node] >= 0:
            carries[nodes.parents[node]] = True
    return bones, {node for node in moved - bones if carries[node]}


@dataclass(frozen=True)
class Joints:
    """The skeleton, and its joints' nodes.

    A uniform scale that all joints have in common, as the 100 of Blender's exports, is taken out of them: it would
    stand in every offset of a joint. What follows them is the same.
    """

    skeleton: Skeleton
    nodes: list[int]  # of each joint
    of_node: Mapping[int, int]
    parents: list[int]  # joint above, -1 for a root
    shrink: FloatArray  # (4, 4) joint -> node
    skins: Mapping[int, BoundSkin]  # slots by cluster of the skin

    def holding(self, nodes: Nodes, node: int) -> int | None:
        """The joint that a node follows: its own, or the nearest above."""
        while node >= 0 and node not in self.of_node:
            node = nodes.parents[node]
        return self.of_node.get(node)


def read_joints(scene: Scene, nodes: Nodes, bones: set[int], turn: FloatArray) -> Joints:
    """The skeleton of `bones`.

    :raises InputError: bind matrices that are not finite or have no inverse
    """
    order = [node for node in nodes.order if node in bones]
    of_node = {node: joint for joint, node in enumerate(order)}
    parents = []
    for node in order:
        above = nodes.parents[node]
        while above >= 0 and above not in of_node:
            above = nodes.parents[above]
        parents.append(of_node.get(above, -1))
    shown: dict[int, str] = {}  # skin -> name of the node that shows its mesh first
    for node in nodes.shown:
        shown.setdefault(nodes.skins[node], nodes.names[node])
    skins = {skin: scene.ids(scene.tables["skins"][skin]["clusters"]) for skin in shown if skin >= 0}
    clusters = scene.tables["clusters"]
    bind_worlds = turn @ matrices(clusters["bind_to_world"])
    inverses = matrices(clusters["geometry_to_bone"])
    used = sorted({cluster for own in skins.values() for cluster in own})
    _check(scene, nodes, clusters, inverses, used)
    scale = _common_scale(bind_worlds[used] if used else nodes.worlds[order])
    shrink, grow = np.diag([1 / scale, 1 / scale, 1 / scale, 1.0]), np.diag([scale, scale, scale, 1.0])
    worlds = nodes.worlds @ shrink
    bindings, bound = Bindings(), {}
    for skin, own in skins.items():
        slots = np.array([of_node[int(clusters["node"][cluster])] for cluster in own])
        first, inverse = np.unique(slots, return_index=True, return_inverse=True)[1:]
        some = [own[place] for place in first]
        one, others = bindings.add(slots[first], grow @ inverses[some], bind_worlds[some] @ shrink)
        if others:
            scene.warn(shown[skin], f"binds {others} joints otherwise than an earlier mesh: joints added")
        if len(first) < len(slots) and np.abs(inverses[own] - inverses[some][inverse]).max() > _ALIKE:
            scene.warn(shown[skin], "binds a joint twice, each time otherwise: the first is kept")
        bound[skin] = BoundSkin(one.slots[inverse], one.geom_bind)
    rest = np.array(
        [
            worlds[node] if parent < 0 else np.linalg.inv(unless_flat(worlds[order[parent]])) @ worlds[node]
            for node, parent in zip(order, parents, strict=True)
        ]
    ).reshape(-1, 4, 4)
    for joint, node in enumerate(order):  # at their own places where no skin says
        if joint not in bindings.binds and parents[joint] < 0:
            bindings.binds[joint] = unless_flat(worlds[node])
    given = [nodes.names[node] for node in order]
    skeleton = bindings.skeleton(given, parents, rest, lambda size: scene.budget.spend(size, scene.error))
    numbered = {skin: bindings.numbered(one, len(order)) for skin, one in bound.items()}
    return Joints(skeleton, order, of_node, parents, shrink, numbered)


def _check(scene: Scene, nodes: Nodes, clusters: Rows, inverses: FloatArray, used: Sequence[int]) -> None:
    finite = np.isfinite(inverses).all(axis=(1, 2)) & np.isfinite(clusters["bind_to_world"]).all(axis=1)
    for cluster in used:
        sizes = np.linalg.svd(inverses[cluster, :3, :3], compute_uv=False) if finite[cluster] else np.zeros(3)
        if not sizes[2] > max(sizes[0] * 1e-7, 1e-30):
            bone = ascii(nodes.names[int(clusters["node"][cluster])])[1:-1][:80]
            raise scene.error(f"the bind matrix of {bone} has no inverse, expected one that has")


def _common_scale(worlds: FloatArray) -> float:
    """The uniform scale of all matrices, to six digits; 1 where they have none in common."""
    lengths = np.linalg.norm(worlds[:, :3, :3], axis=1)
    if not lengths.size or not np.isfinite(lengths).all():
        return 1.0
    scale = float(f"{float(np.median(lengths)):.6g}")
    alike = 1e-6 < scale < 1e6 and np.abs(lengths / scale - 1.0).max() < _ALIKE
    return scale if alike and abs(scale - 1.0) > _ALIKE else 1.0


def read_skin(scene: Scene, name: str, skin: int, joints: Joints, count: int) -> Skin:
    """The weights of a mesh of `count` points, that sum to 1 at each.

    :raises InputError: weights that are not finite, or are not one list a point
    """
    row, bound = scene.tables["skins"][skin], joints.skins[skin]
    vertices, weights = scene.array(row["vertices"], SKIN_VERTEX), scene.array(row["weights"], SKIN_WEIGHT)
    if len(vertices) != count:
        raise scene.error(f"{len(vertices)} lists of weights for {count} points of {ascii(name)[1:-1][:80]}")
    listed = weights[scene.places(vertices, len(weights), f"weights of {ascii(name)[1:-1][:80]}")]
    values = listed["weight"].astype(np.float64)
    if not np.isfinite(values).all() or listed["cluster"].max(initial=0) >= len(bound.slots):
        raise scene.error(f"weights of {ascii(name)[1:-1][:80]} that are not finite, expected finite ones")
    if (values < 0).any():
        scene.warn(name, "weights below 0 taken as 0")
        values = np.maximum(values, 0.0)
    points, slots = np.repeat(np.arange(count), vertices["count"]), bound.slots[listed["cluster"]]
    if int(row["method"]) == _BLENDED:
        scene.warn(name, "blends linear and dual quaternion skinning point by point: taken for linear")
    indices, dense = _dense(scene, points, slots, values, (count, len(joints.skeleton.joints)))
    sums = dense.sum(axis=1)
    if (lost := sums <= 0.0).any():
        scene.warn(
            name,
            f"{int(lost.sum())} points without weight now follow the joint {joints.skeleton.names[bound.slots[0]]}",
        )
        dense[lost, 0], indices[lost, 0], sums[lost] = 1.0, bound.slots[0], 1.0
    if (wrong := np.abs(sums - 1.0) > 1e-5).any():
        found = f"{sums[~lost].min():.4g} to {sums[~lost].max():.4g}"
        scene.warn(name, f"weights of {int(wrong.sum())} points normalised, their sums were {found}")
    return Skin(
        joint_indices=indices,
        joint_weights=(dense / sums[:, None]).astype(np.float32),
        dual_quaternion=int(row["method"]) == _DUAL_QUATERNIONS,
    )


def _dense(
    scene: Scene, points: IntArray, slots: IntArray, values: FloatArray, shape: tuple[int, int]
) -> tuple[IntArray, FloatArray]:
    """Joints (n, k) and weights (n, k) of triples; several weights of a joint at a point are added."""
    kept = values > 0.0
    sparse = scipy.sparse.coo_array((values[kept], (points[kept], slots[kept])), shape=shape).tocsr()
    sparse.sum_duplicates()
    counts = np.diff(sparse.indptr)
    most = max(1, int(counts.max(initial=0)))
    scene.budget.spend(12 * most * shape[0], scene.error)
    rows = np.repeat(np.arange(shape[0]), counts)
    order = np.lexsort((-sparse.data, rows))  # heaviest first
    columns = np.arange(len(rows)) - np.repeat(sparse.indptr[:-1], counts)
    indices, dense = np.zeros((shape[0], most), np.int32), np.zeros((shape[0], most))
    indices[rows, columns], dense[rows, columns] = sparse.indices[order], sparse.data[order]
    return indices, dense


def still(worlds: FloatArray, rest: FloatArray) -> bool:
    """Whether (t, 4, 4) places are all the one at rest."""
    return bool(np.abs(worlds - rest).max(initial=0.0) <= 1e-6 * max(1.0, float(np.abs(rest).max())))


def rigid(count: int, joint: int) -> Skin:
    """The skin of a mesh that follows one joint."""
    return Skin(
        joint_indices=np.full((count, 1), joint, np.int32),
        joint_weights=np.ones((count, 1), np.float32),
        geom_bind_transform=identity(),
    )

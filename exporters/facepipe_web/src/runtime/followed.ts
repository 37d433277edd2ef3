/** Which points of a basis each vertex of a face goes with. */
import type { BufferAttribute, Mesh } from "three";
import type { Basis } from "./basis";
import { FaceError } from "./errors";
import { type FaceMesh, pointNumbers } from "./glb";

/** `vertex = offset + sum share * point`, metres; `width` points for each vertex. */
export interface Followed {
  width: number;
  rows: Int32Array;
  shares: Float32Array;
  offsets: Float32Array;
}

const NEAR = 3;
const NEXT = 1e-4; // metres that points are apart at least

/**
 * Of each primitive: the corners that the file names, of cards and levels of detail; the points of a mesh that the basis
 * has; else the three points of these nearest to it in the file.
 * @throws FaceError no mesh of the basis is there, or one is another
 */
export function followedPoints(meshes: FaceMesh[], basis: Basis): Map<Mesh, Followed> {
  const found = new Map<Mesh, Followed>();
  const before = new Float32Array(3 * basis.count).fill(NaN); // points as they are in the file
  const others: Mesh[] = [];
  for (const mesh of meshes) {
    if (mesh.holds !== null) {
      for (const primitive of mesh.primitives) found.set(primitive, onCorners(primitive, basis, mesh.holds));
      continue;
    }
    const at = basis.meshes.findIndex((one) => one.name === mesh.name);
    if (at < 0) {
      others.push(...mesh.primitives);
      continue;
    }
    if (basis.meshes[at].points !== mesh.pointCount) {
      const expected = `expected the ${basis.meshes[at].points} of ${basis.name}`;
      throw new FaceError("person", `mesh ${mesh.name} has ${mesh.pointCount} points, ${expected}`);
    }
    for (const primitive of mesh.primitives) {
      const own = itself(primitive, firstPoint(basis, mesh.name), mesh.pointCount);
      const { position } = primitive.geometry.attributes;
      own.rows.forEach((row, i) => before.set([position.getX(i), position.getY(i), position.getZ(i)], 3 * row));
      found.set(primitive, own);
    }
  }
  if (!found.size) throw new FaceError("person", `the face has none of the meshes ${basis.meshes.map((one) => one.name).join(", ")}`);
  const near = others.length ? nearestAmong(before) : () => [];
  for (const primitive of others) found.set(primitive, besides(primitive, before, near));
  return found;
}

function firstPoint(basis: Basis, name: string): number {
  const at = basis.meshes.findIndex((one) => one.name === name);
  return basis.meshes.slice(0, at).reduce((sum, one) => sum + one.points, 0);
}

function itself(primitive: Mesh, first: number, count: number): Followed {
  const rows = Int32Array.from(pointNumbers(primitive), (number) => first + number);
  if (!rows.every((row) => row >= first && row < first + count)) throw new FaceError("person", "vertices of points that are not the mesh's");
  return { width: 1, rows, shares: new Float32Array(rows.length).fill(1), offsets: new Float32Array(3 * rows.length) };
}

/** Of cards, which lie on the skin, and levels of detail: docs/files.md, `_FACEPIPE_CORNERS`. */
function onCorners(primitive: Mesh, basis: Basis, surface: string): Followed {
  const { _facepipe_corners: corners, _facepipe_shares: shares, _facepipe_offset: offset } = primitive.geometry.attributes;
  const points = basis.meshes.find((one) => one.name === surface)?.points ?? 0;
  if (!corners || !shares || !offset || !points) throw new FaceError("person", `a mesh without what holds it on ${surface}`);
  const first = firstPoint(basis, surface);
  const made = room(corners.count);
  for (let i = 0; i < corners.count; i++) {
    const [a, b] = [shares.getX(i), shares.getY(i)];
    made.shares.set([a, b, 1 - a - b], NEAR * i);
    made.offsets.set([offset.getX(i), offset.getY(i), offset.getZ(i)], 3 * i);
    const own = [corners.getX(i), corners.getY(i), corners.getZ(i)];
    if (!own.every((corner) => corner >= 0 && corner < points)) throw new FaceError("person", `corners ${own}, expected points of ${surface}`);
    made.rows.set(own.map((corner) => first + corner), NEAR * i);
  }
  return made;
}

function besides(primitive: Mesh, before: Float32Array, near: Nearest): Followed {
  const position = primitive.geometry.attributes.position as BufferAttribute;
  const made = room(position.count);
  for (let i = 0; i < position.count; i++) {
    const place = [position.getX(i), position.getY(i), position.getZ(i)];
    const rows = near(place);
    const shares = rows.map(({ square }) => 1 / (Math.sqrt(square) + NEXT));
    const total = shares.reduce((sum, share) => sum + share, 0);
    rows.forEach(({ row }, k) => {
      const share = shares[k] / total;
      made.rows[NEAR * i + k] = row;
      made.shares[NEAR * i + k] = share;
      for (let axis = 0; axis < 3; axis++) place[axis] -= share * before[3 * row + axis];
    });
    made.offsets.set(place, 3 * i);
  }
  return made;
}

function room(count: number): Followed {
  return { width: NEAR, rows: new Int32Array(NEAR * count), shares: new Float32Array(NEAR * count), offsets: new Float32Array(3 * count) };
}

type Nearest = (place: number[]) => { row: number; square: number }[];

/** The NEAR nearest of points: from the same height on, up and down, until heights alone are farther apart. */
function nearestAmong(points: Float32Array): Nearest {
  const known = Array.from({ length: points.length / 3 }, (_, i) => i).filter((row) => !Number.isNaN(points[3 * row]));
  known.sort((a, b) => points[3 * a + 1] - points[3 * b + 1]);
  return ([x, y, z]) => {
    let [low, high] = [0, known.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (points[3 * known[middle] + 1] < y) low = middle + 1;
      else high = middle;
    }
    const best = Array.from({ length: NEAR }, () => ({ row: known[0], square: Infinity }));
    const take = (row: number): boolean => {
      const [dx, dy, dz] = [points[3 * row] - x, points[3 * row + 1] - y, points[3 * row + 2] - z];
      const square = dx * dx + dy * dy + dz * dz;
      const place = best.findIndex((one) => square < one.square);
      if (place >= 0) best.splice(place, 0, { row, square }), best.pop();
      return dy * dy < best[NEAR - 1].square;
    };
    for (let i = low; i < known.length && take(known[i]); i++);
    for (let i = low - 1; i >= 0 && take(known[i]); i--);
    return best.filter((one) => one.square < Infinity);
  };
}

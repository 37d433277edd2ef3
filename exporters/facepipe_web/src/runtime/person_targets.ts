/** Shapes in the targets of a face's meshes: as in its file, or turned as a person's, with lids that fit the eyeballs. */
import { BufferAttribute, type BufferGeometry, type Mesh } from "three";
import type { Followed } from "./followed";
import type { FaceMesh } from "./glb";
import type { LidShape } from "./lids";
import { along } from "./targets";

const MM = 1e-3; // metres
const STILL = 1e-6; // of a target at the weight that its offsets are at

const kept = new WeakMap<BufferGeometry, Map<number, NonNullable<BufferGeometry["morphAttributes"]["position"]>[number]>>(); // the file's

/**
 * Put shapes in place of those of the file: points of lids go as they say, and what lies on these goes as much farther.
 * @param count of points of the basis
 */
export function setLids(meshes: FaceMesh[], followed: Map<Mesh, Followed>, count: number, shapes: LidShape[]): void {
  for (const { name, weight, points, offsets } of shapes) {
    const numbers = new Int32Array(count).fill(-1);
    points.forEach((point, i) => (numbers[point] = i));
    const farther = new Float32Array(3 * count); // than in the file
    const of = (mesh: FaceMesh) =>
      mesh.targets.findIndex((target) => {
        const own = mesh.curves[target] ? along(mesh.curves[target], weight) : weight;
        return (mesh.inbetweens[target]?.shape ?? target) === name && Math.abs(own - 1) < STILL;
      });
    const ordered = [...meshes.filter((mesh) => mesh.holds === null), ...meshes.filter((mesh) => mesh.holds !== null)];
    for (const mesh of ordered.filter((one) => of(one) >= 0)) {
      for (const primitive of mesh.primitives) {
        const { width, rows, shares } = followed.get(primitive)!;
        if (mesh.holds === null && width === 1) {
          if (!rows.some((row) => numbers[row] >= 0)) continue;
          const target = own(primitive.geometry, of(mesh));
          rows.forEach((row, vertex) => {
            for (let axis = 0; numbers[row] >= 0 && axis < 3; axis++) {
              const value = MM * offsets[3 * numbers[row] + axis];
              farther[3 * row + axis] = value - target[3 * vertex + axis];
              target[3 * vertex + axis] = value;
            }
          });
        } else if (mesh.holds !== null && rows.some((row) => numbers[row] >= 0)) {
          const target = own(primitive.geometry, of(mesh));
          rows.forEach((row, at) => {
            for (let axis = 0; axis < 3; axis++) target[3 * Math.floor(at / width) + axis] += shares[at] * farther[3 * row + axis];
          });
        }
      }
    }
  }
}

/**
 * Turn all shapes but some.
 * @param rows 9 numbers
 * @param but shapes that are set otherwise
 */
export function turnShapes(meshes: FaceMesh[], rows: number[], but: ReadonlySet<string>): void {
  const [a, b, c, d, e, f, g, h, k] = rows;
  for (const { primitives, targets, inbetweens } of meshes) {
    targets.forEach((target, number) => {
      if (but.has(inbetweens[target]?.shape ?? target)) return;
      for (const { geometry } of primitives) {
        const moves = own(geometry, number);
        for (let i = 0; i < moves.length; i += 3) {
          const [x, y, z] = moves.subarray(i, i + 3);
          moves[i] = a * x + b * y + c * z;
          moves[i + 1] = d * x + e * y + f * z;
          moves[i + 2] = g * x + h * y + k * z;
        }
      }
    });
  }
}

/** Put the shapes of the file back. */
export function resetShapes(meshes: FaceMesh[]): void {
  for (const { geometry } of meshes.flatMap((mesh) => mesh.primitives)) {
    const file = kept.get(geometry);
    if (!file) continue;
    for (const [target, attribute] of file) geometry.morphAttributes.position![target] = attribute;
    kept.delete(geometry);
    geometry.dispose(); // three.js has targets in a texture that it makes once
  }
}

/** The numbers of a target as floats that may be written; the file's stay aside. */
function own(geometry: BufferGeometry, target: number): Float32Array {
  if (!kept.has(geometry)) {
    kept.set(geometry, new Map());
    geometry.dispose();
  }
  const file = geometry.morphAttributes.position![target];
  kept.get(geometry)!.set(target, file);
  const made = new Float32Array(3 * file.count);
  for (let i = 0; i < file.count; i++) made.set([file.getX(i), file.getY(i), file.getZ(i)], 3 * i);
  geometry.morphAttributes.position![target] = new BufferAttribute(made, 3);
  return made;
}

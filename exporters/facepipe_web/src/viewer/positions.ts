/** New neutral points for a face that is shown. */
import { type BufferGeometry, Vector3 } from "three";
import { pointNumbers } from "../runtime/glb";
import type { ViewedFace } from "./viewed_face";

/** @param points 3 numbers for each point of all meshes of the stage, metres, Y up */
export function setPositions({ face, details }: ViewedFace, points: Float32Array): void {
  let first = 0;
  for (const { name, points: count } of details?.meshes ?? []) {
    const mesh = face.meshes.find((one) => one.name === name);
    for (const primitive of mesh?.primitives ?? []) {
      const { geometry } = primitive;
      const numbers = pointNumbers(primitive);
      const { position } = geometry.attributes;
      for (let vertex = 0; vertex < numbers.length; vertex++) {
        const at = 3 * (first + numbers[vertex]);
        position.setXYZ(vertex, points[at], points[at + 1], points[at + 2]);
      }
      position.needsUpdate = true;
      setNormals(geometry, numbers, count);
    }
    first += count;
  }
}

/** Area-weighted normals of points: vertices at a seam share theirs. */
function setNormals(geometry: BufferGeometry, numbers: ArrayLike<number>, count: number): void {
  const { position, normal } = geometry.attributes;
  const sums = new Float32Array(3 * count);
  const index = geometry.index!;
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  for (let corner = 0; corner < index.count; corner += 3) {
    const vertices = [index.getX(corner), index.getX(corner + 1), index.getX(corner + 2)];
    a.fromBufferAttribute(position, vertices[0]);
    b.fromBufferAttribute(position, vertices[1]).sub(a);
    c.fromBufferAttribute(position, vertices[2]).sub(a);
    b.cross(c);
    for (const vertex of vertices) {
      sums[3 * numbers[vertex]] += b.x;
      sums[3 * numbers[vertex] + 1] += b.y;
      sums[3 * numbers[vertex] + 2] += b.z;
    }
  }
  for (let vertex = 0; vertex < numbers.length; vertex++) {
    a.fromArray(sums, 3 * numbers[vertex]).normalize();
    normal.setXYZ(vertex, a.x, a.y, a.z);
  }
  normal.needsUpdate = true;
}

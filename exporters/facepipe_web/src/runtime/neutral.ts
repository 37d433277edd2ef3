/** The neutral of a face's meshes: as in its file, or with other points. */
import { BufferAttribute, type BufferGeometry, type Mesh, Vector3 } from "three";
import { type FaceMesh, pointNumbers } from "./glb";

type Attribute = BufferGeometry["attributes"][string];
type Writable = BufferAttribute["array"];

const kept = new WeakMap<BufferGeometry, Record<string, { file: Attribute; own: BufferAttribute }>>();

/**
 * Put a mesh's vertices elsewhere, with normals and tangents that fit: area-weighted over all its primitives, vertices at
 * a seam share theirs. Targets stay what they add.
 * @param place writes where a vertex of a primitive is, which stands for a point; metres
 */
export function setNeutral(mesh: FaceMesh, place: (primitive: Mesh, vertex: number, point: number, out: Vector3) => void): void {
  const sums = new Float32Array(3 * mesh.pointCount);
  const at = new Vector3();
  for (const primitive of mesh.primitives) {
    const { geometry } = primitive;
    const [numbers, position] = [pointNumbers(primitive), own(geometry, "position")!.array];
    for (let vertex = 0; vertex < numbers.length; vertex++) {
      place(primitive, vertex, numbers[vertex], at);
      at.toArray(position, 3 * vertex);
    }
    addNormals(sums, geometry.index!.array, numbers, position);
    geometry.boundingBox = geometry.boundingSphere = null;
  }
  for (const primitive of mesh.primitives) {
    const numbers = pointNumbers(primitive);
    const normal = own(primitive.geometry, "normal")?.array;
    const tangent = own(primitive.geometry, "tangent")?.array;
    for (let vertex = 0; normal && vertex < numbers.length; vertex++) {
      const from = 3 * numbers[vertex];
      const length = Math.sqrt(sums[from] ** 2 + sums[from + 1] ** 2 + sums[from + 2] ** 2);
      if (!length) continue; // of no triangle: as it was
      const [x, y, z] = [sums[from] / length, sums[from + 1] / length, sums[from + 2] / length];
      const to = 3 * vertex;
      normal[to] = x;
      normal[to + 1] = y;
      normal[to + 2] = z;
      if (tangent) turnTangent(tangent, 4 * vertex, x, y, z);
    }
  }
}

/** Add the normals of triangles, as long as their areas, to sums by points; numbers alone, as faces are dragged by this. */
function addNormals(sums: Float32Array, index: ArrayLike<number>, numbers: ArrayLike<number>, position: ArrayLike<number>): void {
  for (let corner = 0; corner < index.length; corner += 3) {
    const [a, b, c] = [3 * index[corner], 3 * index[corner + 1], 3 * index[corner + 2]];
    const [ux, uy, uz] = [position[b] - position[a], position[b + 1] - position[a + 1], position[b + 2] - position[a + 2]];
    const [vx, vy, vz] = [position[c] - position[a], position[c + 1] - position[a + 1], position[c + 2] - position[a + 2]];
    const [x, y, z] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (let k = 0; k < 3; k++) {
      const to = 3 * numbers[index[corner + k]];
      sums[to] += x;
      sums[to + 1] += y;
      sums[to + 2] += z;
    }
  }
}

/** Make a tangent stand on a normal again. */
function turnTangent(tangent: Writable, at: number, x: number, y: number, z: number): void {
  const along = tangent[at] * x + tangent[at + 1] * y + tangent[at + 2] * z;
  const [tx, ty, tz] = [tangent[at] - along * x, tangent[at + 1] - along * y, tangent[at + 2] - along * z];
  const length = Math.sqrt(tx * tx + ty * ty + tz * tz) || 1;
  tangent[at] = tx / length;
  tangent[at + 1] = ty / length;
  tangent[at + 2] = tz / length;
}

/**
 * Put a mesh's vertices where the file has them, and then further.
 * @param offsets 3 numbers a point, metres; those of the mesh begin at point `first`
 */
export function offsetNeutral(mesh: FaceMesh, offsets: Float32Array, first: number): void {
  setNeutral(mesh, ({ geometry }, vertex, point, out) => {
    const [file, at, from] = [filePositions(geometry), 3 * (first + point), 3 * vertex];
    out.set(file[from] + offsets[at], file[from + 1] + offsets[at + 1], file[from + 2] + offsets[at + 2]);
  });
}

const positions = new WeakMap<BufferGeometry, Writable>();

/** Where the file has the vertices, as floats. */
function filePositions(geometry: BufferGeometry): Writable {
  let found = positions.get(geometry);
  if (!found) positions.set(geometry, (found = floats(kept.get(geometry)!.position.file).array));
  return found;
}

/** Put a mesh's vertices back where they are in the file. */
export function resetNeutral(mesh: FaceMesh): void {
  for (const { geometry } of mesh.primitives) {
    for (const [name, { file }] of Object.entries(kept.get(geometry) ?? {})) geometry.setAttribute(name, file);
  }
}

/** An attribute as floats that may be written: the file's own stays aside, which may be bytes, too coarse for normals. */
function own(geometry: BufferGeometry, name: "position" | "normal" | "tangent"): BufferAttribute | null {
  const all = kept.get(geometry) ?? {};
  kept.set(geometry, all);
  const file = all[name]?.file ?? geometry.attributes[name];
  if (!file) return null;
  all[name] ??= { file, own: floats(file) };
  geometry.setAttribute(name, all[name].own);
  all[name].own.needsUpdate = true;
  return all[name].own;
}

function floats(attribute: Attribute): BufferAttribute {
  const { count, itemSize } = attribute;
  const made = new BufferAttribute(new Float32Array(count * itemSize), itemSize);
  for (let i = 0; i < count; i++) for (let k = 0; k < itemSize; k++) made.setComponent(i, k, attribute.getComponent(i, k));
  return made;
}

/** The neutral of a face's meshes: as in its file, or with other points. */
import { BufferAttribute, type BufferGeometry, type Mesh, Vector3 } from "three";
import { type FaceMesh, pointNumbers } from "./glb";

type Attribute = BufferGeometry["attributes"][string];

const kept = new WeakMap<BufferGeometry, Record<string, { file: Attribute; own: BufferAttribute }>>();

/**
 * Put a mesh's vertices elsewhere, with normals and tangents that fit: area-weighted over all its primitives, vertices at
 * a seam share theirs. Targets stay what they add.
 * @param place writes where a vertex of a primitive is, which stands for a point; metres
 */
export function setNeutral(mesh: FaceMesh, place: (primitive: Mesh, vertex: number, point: number, out: Vector3) => void): void {
  const sums = new Float32Array(3 * mesh.pointCount);
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  for (const primitive of mesh.primitives) {
    const { geometry } = primitive;
    const [numbers, position] = [pointNumbers(primitive), own(geometry, "position")!];
    for (let vertex = 0; vertex < numbers.length; vertex++) {
      place(primitive, vertex, numbers[vertex], a);
      a.toArray(position.array, 3 * vertex);
    }
    const index = geometry.index!;
    for (let corner = 0; corner < index.count; corner += 3) {
      const vertices = [index.getX(corner), index.getX(corner + 1), index.getX(corner + 2)];
      a.fromArray(position.array, 3 * vertices[0]);
      b.fromArray(position.array, 3 * vertices[1]).sub(a);
      c.fromArray(position.array, 3 * vertices[2]).sub(a);
      b.cross(c);
      for (const vertex of vertices) {
        const at = 3 * numbers[vertex];
        sums[at] += b.x;
        sums[at + 1] += b.y;
        sums[at + 2] += b.z;
      }
    }
    geometry.boundingBox = geometry.boundingSphere = null;
  }
  for (const primitive of mesh.primitives) {
    const numbers = pointNumbers(primitive);
    const [normal, tangent] = [own(primitive.geometry, "normal"), own(primitive.geometry, "tangent")];
    for (let vertex = 0; normal && vertex < numbers.length; vertex++) {
      a.fromArray(sums, 3 * numbers[vertex]);
      if (!a.lengthSq()) continue; // of no triangle: as it was
      a.normalize().toArray(normal.array, 3 * vertex);
      if (!tangent) continue;
      b.fromArray(tangent.array, 4 * vertex);
      b.addScaledVector(a, -b.dot(a)).normalize().toArray(tangent.array, 4 * vertex);
    }
  }
}

/**
 * Put a mesh's vertices where the file has them, and then further.
 * @param offsets 3 numbers a point, metres; those of the mesh begin at point `first`
 */
export function offsetNeutral(mesh: FaceMesh, offsets: Float32Array, first: number): void {
  setNeutral(mesh, ({ geometry }, vertex, point, out) => {
    const at = 3 * (first + point);
    out.fromBufferAttribute(kept.get(geometry)!.position.file as BufferAttribute, vertex);
    out.set(out.x + offsets[at], out.y + offsets[at + 1], out.z + offsets[at + 2]);
  });
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

/** Whether a GLB and a graph are of one face. */
import { FaceError } from "./errors";
import type { FaceMesh, LoadedGlb } from "./glb";
import { type Marks, type Metadata, output } from "./metadata";
import { readPoints } from "./read_points";

const TOLERANCE = 1e-3; // of the head height

/**
 * @param glb at the neutral
 * @throws FaceError other joints, meshes, targets, another size or other points
 */
export function checkSameFace(glb: LoadedGlb, metadata: Metadata, where: string): void {
  const differ = (what: string) => new FaceError(where, `GLB and ONNX are of different faces: ${what}`);
  const joints = output(metadata, "skinning_matrices")?.joints ?? [];
  const own = glb.skeleton?.bones.length ?? 0;
  if (joints.length !== own) throw differ(`${own} joints in the GLB, ${joints.length} in the ONNX`);
  const targets = output(metadata, "morph_weights")?.targets ?? [];
  const records = new Map(metadata.meshes.map((one) => [one.name, one]));
  for (const mesh of glb.meshes) {
    const record = records.get(mesh.name);
    if (!record) throw differ(`mesh ${mesh.name} is not in the ONNX`);
    if (record.count !== mesh.pointCount) {
      throw differ(`mesh ${mesh.name} has ${mesh.pointCount} points in the GLB, ${record.count} in the ONNX`);
    }
    const other = differing(mesh, record.targets.map((number) => targets[number]?.name));
    if (other) throw differ(`shapes of mesh ${mesh.name} differ: ${other}`);
  }
  const neutrals = glb.meshes.map((mesh) => readPoints(glb.root, mesh, NaN));
  const expected = metadata.face.head_height * metadata.face.meters_per_unit;
  const height = heightOf(neutrals);
  if (Math.abs(height - expected) > TOLERANCE * expected) {
    throw differ(`the head is ${mm(height)} high in the GLB, ${mm(expected)} in the ONNX`);
  }
  glb.meshes.forEach(({ name }, i) => {
    const { marks } = records.get(name)!;
    const far = marks && farthest(neutrals[i], marks);
    if (far && far.distance > TOLERANCE * expected) {
      throw differ(`point ${far.point} of mesh ${name} is ${mm(far.distance)} from where the ONNX has it`);
    }
  });
}

/** Metres from the lowest to the highest of points; NaN where some are missing. */
function heightOf(meshes: Float32Array[]): number {
  let [low, high] = [Infinity, -Infinity];
  for (const points of meshes) {
    for (let i = 1; i < points.length; i += 3) {
      if (Number.isNaN(points[i])) return NaN; // a loose point counts in the ONNX alone
      low = Math.min(low, points[i]);
      high = Math.max(high, points[i]);
    }
  }
  return high - low;
}

/** The mark that lies farthest from its point. */
function farthest(points: Float32Array, marks: Marks): { point: number; distance: number } {
  const found = { point: -1, distance: 0 };
  marks.points.forEach((point, i) => {
    const distance = Math.hypot(...marks.positions[i].map((value, k) => value - points[3 * point + k]));
    if (distance > found.distance) Object.assign(found, { point, distance }); // never for NaN
  });
  return found;
}

/** The first target that differs. */
function differing(mesh: FaceMesh, names: (string | undefined)[]): string | null {
  if (mesh.targets.length !== names.length) return `${mesh.targets.length} in the GLB, ${names.length} in the ONNX`;
  const at = mesh.targets.findIndex((name, i) => name !== names[i]);
  return at < 0 ? null : `${mesh.targets[at]} in the GLB, ${names[at]} in the ONNX`;
}

function mm(metres: number): string {
  return `${(1000 * metres).toFixed(1)} mm`;
}

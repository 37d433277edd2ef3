/** Whether a GLB and a graph are of one face. */
import { FaceError } from "./errors";
import type { FaceMesh, LoadedGlb } from "./glb";
import { type Metadata, output } from "./metadata";

const TOLERANCE = 1e-3; // of the head height

/**
 * @param height metres from the lowest to the highest point of the neutral in the GLB
 * @throws FaceError other joints, meshes, targets or another size
 */
export function checkSameFace(glb: LoadedGlb, metadata: Metadata, height: number, where: string): void {
  const differ = (what: string) => new FaceError(where, `GLB and ONNX are of different faces: ${what}`);
  const joints = output(metadata, "skinning_matrices")?.joints ?? [];
  const own = glb.skeleton?.bones.length ?? 0;
  if (joints.length !== own) throw differ(`${own} joints in the GLB, ${joints.length} in the ONNX`);
  if (glb.quantised && joints.length) {
    throw new FaceError(where, "the GLB is quantised, expected one without --quantize");
  }
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
  const expected = metadata.face.head_height * metadata.face.meters_per_unit;
  if (Math.abs(height - expected) > TOLERANCE * expected) {
    throw differ(`the head is ${mm(height)} high in the GLB, ${mm(expected)} in the ONNX`);
  }
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

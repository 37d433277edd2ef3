/** Loading a face: its GLB, and the ONNX of its sliders. */
import { Face, type JointFacts } from "./face";
import { readGlb } from "./glb";
import { readMetadata } from "./metadata";
import { Network, type NetworkOptions } from "./network";
import { checkSameFace } from "./same_face";

export interface LoadOptions extends NetworkOptions {
  /** joints of a GLB without ONNX, which payloads need */
  joints?: JointFacts;
}

/**
 * Load a face; with an ONNX at the values that are set on it, otherwise with shapes alone.
 * @param glbUrl of `facepipe export FACE -o face.glb`
 * @param onnxUrl of `facepipe export FACE --sliders -o sliders.onnx`; its sidecar is beside it
 * @throws FaceError files that don't load or are of different faces, or a browser without WebAssembly
 */
export async function loadFace(glbUrl: string, onnxUrl: string | null = null, options: LoadOptions = {}): Promise<Face> {
  const metadata = onnxUrl === null ? null : await readMetadata(onnxUrl);
  const glb = await readGlb(glbUrl);
  if (metadata === null || onnxUrl === null) return new Face(glb, null, options.joints ?? null);
  checkSameFace(glb, metadata, `${glbUrl}, ${onnxUrl}`);
  const network = await Network.load(onnxUrl, metadata, options);
  const face = new Face(glb, network);
  await face.setSliders(Object.fromEntries(face.sliders.map((one) => [one.name, one.value])));
  return face;
}

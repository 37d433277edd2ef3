/** The sidecar of a graph of sliders (docs/files.md, "Graphs of sliders"). */
import { FaceError, fetched } from "./errors";

export interface SliderInput {
  name: "sliders";
  names: string[];
  groups: string[];
  /** values of the neutral */
  default: number[];
  /** values that are set on the face */
  values: number[];
  range: [number, number][];
}

export interface Input {
  name: string;
  shape: number[];
  names?: string[];
  default?: unknown;
}

export interface Output {
  name: string;
  shape: number[];
  joints?: string[];
  gltf_from_world?: number[][];
  skeleton_from_gltf?: number[][];
  targets?: { name: string; shape: string }[];
}

export interface Marks {
  points: number[];
  positions: [number, number, number][];
}

export interface Metadata {
  face: { head_height: number; meters_per_unit: number; name: string; up_axis: "Y" | "Z" };
  format: { name: string; version: number };
  inputs: Input[];
  joints: { path: string; parent: number }[];
  /** `marks`: some points by their numbers, metres, Y up; files of older versions have none */
  meshes: { name: string; first: number; count: number; targets: number[]; marks?: Marks }[];
  outputs: Output[];
  sliders: { name: string; mirror: string | null }[];
}

/**
 * The metadata of the graph at `onnxUrl`, from the file beside it.
 * @throws FaceError no sidecar, or that of another kind of graph
 */
export async function readMetadata(onnxUrl: string): Promise<Metadata> {
  const url = `${onnxUrl}.json`;
  let metadata: Metadata;
  try {
    metadata = (await (await fetched(url)).json()) as Metadata;
  } catch (error) {
    if (error instanceof FaceError) throw error;
    throw new FaceError(url, "no JSON, expected the sidecar that is written with the ONNX file");
  }
  const format = metadata?.format?.name;
  if (format !== "facepipe sliders") {
    throw new FaceError(url, `a graph of '${format}', expected 'facepipe sliders' (facepipe export --sliders)`);
  }
  return metadata;
}

/** The input of slider values. */
export function sliderInput(metadata: Metadata): SliderInput {
  return metadata.inputs[0] as unknown as SliderInput;
}

/** The output `name`; undefined where the face has not what it moves. */
export function output(metadata: Metadata, name: string): Output | undefined {
  return metadata.outputs.find((one) => one.name === name);
}

/** The graph of a face's sliders in onnxruntime-web. */
import type { InferenceSession, Tensor } from "onnxruntime-web";
import { FaceError, fetched } from "./errors";
import { type Metadata, sliderInput } from "./metadata";

export type Backend = "wasm" | "webgpu";
type Runtime = typeof import("onnxruntime-web");

export interface NetworkOptions {
  /** what evaluates the graph (wasm): a graph so small is faster on the CPU than its way to the GPU and back */
  backend?: Backend;
  /** threads of WebAssembly (1: more cost more than they save) */
  threads?: number;
  /** folder of onnxruntime-web's .wasm files; default: beside the script */
  wasmFolder?: string;
}

/** What moves a face: skinning matrices row by row, and activations of the morph targets. */
export interface Evaluation {
  matrices: Float32Array | null;
  morphs: Float32Array | null;
}

const WANTED = ["skinning_matrices", "morph_weights"];

interface Gpu {
  requestAdapter(): Promise<object | null>;
}

/** Whether the browser has WebGPU, and a device for it. */
async function hasWebGpu(): Promise<boolean> {
  const { gpu } = navigator as { gpu?: Gpu };
  return Boolean(await gpu?.requestAdapter());
}

export class Network {
  private readonly feeds: Record<string, Tensor> = {};
  private readonly wanted: string[];

  private constructor(
    private readonly session: InferenceSession,
    runtime: Runtime,
    readonly metadata: Metadata,
    readonly backend: Backend,
  ) {
    this.wanted = metadata.outputs.map((one) => one.name).filter((name) => WANTED.includes(name));
    for (const { name, shape, default: value } of metadata.inputs) {
      const size = shape.reduce((product, one) => product * one, 1);
      const filled = name === "parent" ? Float32Array.from((value as number[][]).flat()) : new Float32Array(size);
      this.feeds[name] = new runtime.Tensor("float32", filled, shape);
    }
    this.values("sliders").set(sliderInput(metadata).default);
  }

  /**
   * @throws FaceError a browser without WebAssembly, a graph that does not load, or one made for batches
   */
  static async load(onnxUrl: string, metadata: Metadata, options: NetworkOptions = {}): Promise<Network> {
    if (typeof WebAssembly === "undefined") {
      throw new FaceError("browser", "has no WebAssembly, which the sliders need");
    }
    if (metadata.inputs[0].shape[0] !== 1) {
      throw new FaceError(onnxUrl, `a graph for ${metadata.inputs[0].shape[0]} poses at once, expected one`);
    }
    const gpu = options.backend === "webgpu" && (await hasWebGpu());
    const runtime = (gpu ? await import("onnxruntime-web/webgpu") : await import("onnxruntime-web/wasm")) as Runtime;
    runtime.env.wasm.numThreads = options.threads ?? 1;
    if (options.wasmFolder) runtime.env.wasm.wasmPaths = options.wasmFolder;
    const bytes = new Uint8Array(await (await fetched(onnxUrl)).arrayBuffer());
    try {
      const executionProviders = gpu ? ["webgpu", "wasm"] : ["wasm"];
      const session = await runtime.InferenceSession.create(bytes, { executionProviders });
      return new Network(session, runtime, metadata, gpu ? "webgpu" : "wasm");
    } catch (error) {
      throw new FaceError(onnxUrl, `does not load: ${String((error as Error)?.message ?? error).split("\n")[0]}`);
    }
  }

  /** The numbers of the input `name`, to be written in place; empty where the graph has no such input. */
  values(name: "sliders" | "weights"): Float32Array {
    return (this.feeds[name]?.data as Float32Array | undefined) ?? new Float32Array(0);
  }

  /** Evaluate the values as they are. */
  async run(): Promise<Evaluation> {
    const found = await this.session.run(this.feeds, this.wanted);
    return {
      matrices: (found.skinning_matrices?.data as Float32Array | undefined) ?? null,
      morphs: (found.morph_weights?.data as Float32Array | undefined) ?? null,
    };
  }

  async release(): Promise<void> {
    await this.session.release();
  }
}

// Runs an ONNX model with onnxruntime-web's WebAssembly build, which browsers load, and prints its outputs as JSON.
// usage: node onnx_run.mjs FILE < request
// request: [{input name: {"dims": [...], "data": [...]}}, ...], float32
// answer:  [{output name: {"dims": [...], "data": [...]}}, ...]
import { readFileSync } from "node:fs";
import * as ort from "onnxruntime-web/wasm";

ort.env.wasm.numThreads = 1;
const [path] = process.argv.slice(2);
const session = await ort.InferenceSession.create(new Uint8Array(readFileSync(path)), { executionProviders: ["wasm"] });
const answers = [];
for (const request of JSON.parse(readFileSync(0, "utf8"))) {
  const entries = Object.entries(request);
  const feeds = entries.map(([name, { dims, data }]) => [name, new ort.Tensor("float32", Float32Array.from(data), dims)]);
  const outputs = Object.entries(await session.run(Object.fromEntries(feeds)));
  answers.push(Object.fromEntries(outputs.map(([name, { dims, data }]) => [name, { dims, data: Array.from(data) }])));
}
console.log(JSON.stringify(answers));

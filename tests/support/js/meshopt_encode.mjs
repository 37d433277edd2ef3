// Compresses arrays with meshoptimizer and prints what its own decoder makes of them, as JSON.
// usage: node meshopt_encode.mjs < request
// request: [{"data": base64, "count", "size", "mode", "filter"}]; a filter's input is float32, four components an element
// answer: [{"packed": base64, "decoded": base64}]
import { readFileSync } from "node:fs";
import { MeshoptDecoder } from "meshoptimizer/decoder";
import { MeshoptEncoder } from "meshoptimizer/encoder";

await Promise.all([MeshoptEncoder.ready, MeshoptDecoder.ready]);
const filters = {
  OCTAHEDRAL: (data, count, size) => MeshoptEncoder.encodeFilterOct(data, count, size, size === 4 ? 8 : 16),
  QUATERNION: (data, count, size) => MeshoptEncoder.encodeFilterQuat(data, count, size, 16),
  EXPONENTIAL: (data, count, size) => MeshoptEncoder.encodeFilterExp(data, count, size, 15),
};
const text = (bytes) => Buffer.from(bytes).toString("base64");
const answers = JSON.parse(readFileSync(0, "utf8")).map(({ data, count, size, mode, filter }) => {
  const given = new Uint8Array(Buffer.from(data, "base64"));
  const source = filter ? filters[filter](new Float32Array(given.buffer), count, size) : given;
  const packed = MeshoptEncoder.encodeGltfBuffer(source, count, size, mode, 0);
  const decoded = new Uint8Array(count * size);
  MeshoptDecoder.decodeGltfBuffer(decoded, count, size, packed, mode, filter ?? "NONE");
  return { packed: text(packed), decoded: text(decoded) };
});
console.log(JSON.stringify(answers));

// Compresses meshes with Draco and prints what they became, as JSON.
// usage: node draco_encode.mjs < request
// request: [{"triangles": [...], "attributes": [{"kind", "type", "components", "values": [...]}], "method", "bits": {kind: n}}];
// kind is POSITION, NORMAL, COLOR, TEX_COORD or GENERIC, type the name of a typed array, method SEQUENTIAL or EDGEBREAKER
// answer: [{"packed": base64, "order": [...]}]: attributes have numbers from 0, and order is the vertices as they come out
import { readFileSync } from "node:fs";
import draco from "draco3dgltf";

const encoders = await draco.createEncoderModule({});
const decoders = await draco.createDecoderModule({});

function packed({ triangles, attributes, method, bits }) {
  const encoder = new encoders.Encoder();
  const builder = new encoders.MeshBuilder();
  const mesh = new encoders.Mesh();
  const bytes = new encoders.DracoInt8Array();
  builder.AddFacesToMesh(mesh, triangles.length / 3, new Uint32Array(triangles));
  for (const { kind, type, components, values } of attributes) {
    const add = `Add${type.replace("Uint", "UInt").replace("Float32", "Float")}Attribute`;
    const array = new globalThis[`${type}Array`](values);
    builder[add](mesh, encoders[kind], values.length / components, components, array);
  }
  const count = attributes[0].values.length / attributes[0].components;
  builder.AddUInt32Attribute(mesh, encoders.GENERIC, count, 1, new Uint32Array(count).map((_, i) => i));
  for (const [kind, count] of Object.entries(bits)) encoder.SetAttributeQuantization(encoders[kind], count);
  encoder.SetEncodingMethod(encoders[`MESH_${method}_ENCODING`]);
  encoder.SetSpeedOptions(0, 0);
  if (!encoder.EncodeMeshToDracoBuffer(mesh, bytes)) throw new Error("Draco did not encode a mesh");
  return Int8Array.from({ length: bytes.size() }, (_, i) => bytes.GetValue(i));
}

function order(data, number) {
  const decoder = new decoders.Decoder();
  const mesh = new decoders.Mesh();
  const values = new decoders.DracoUInt32Array();
  decoder.DecodeArrayToMesh(data, data.byteLength, mesh);
  decoder.GetAttributeUInt32ForAllPoints(mesh, decoder.GetAttributeByUniqueId(mesh, number), values);
  return Array.from({ length: values.size() }, (_, i) => values.GetValue(i));
}

const answers = JSON.parse(readFileSync(0, "utf8")).map((request) => {
  const data = packed(request);
  return { packed: Buffer.from(data.buffer).toString("base64"), order: order(data, request.attributes.length) };
});
console.log(JSON.stringify(answers));

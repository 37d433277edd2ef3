// What programs that pose GLBs in an engine share: they read a request from stdin, and answer in files.
// request: [{"path", "out", "poses": [{"weights": {mesh: {target: weight}}, "joints": {joint: [10 numbers]}}]}]; a joint's
//          numbers are its local translation, rotation (x y z w) and scale, as in a glTF node
// answer:  [{"points": [...]}]: for each file, for each primitive, the points that its vertices stand for, null where the
//          engine did not keep them; `out` gets float32 x y z of all vertices, primitive by primitive, pose by pose:
//          deformed, in the world, metres, Y up
import { readFileSync, writeFileSync } from "node:fs";

/** The bytes of a file, as an ArrayBuffer of its own. */
export function bytesOf(path) {
  const bytes = readFileSync(path);
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
}

/** Answers the request with what `load` makes of a path: points, and pose(one), a Float32Array for each primitive. */
export async function answer(load) {
  const answers = [];
  for (const { path, out, poses } of JSON.parse(readFileSync(0, "utf8"))) {
    const { points, pose } = await load(path);
    writeFileSync(out, Buffer.concat(poses.flatMap(pose).map((one) => Buffer.from(one.buffer))));
    answers.push({ points });
  }
  console.log(JSON.stringify(answers));
}

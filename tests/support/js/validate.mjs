// Runs the Khronos glTF validator on files and prints {path: report} as JSON.
// usage: node validate.mjs FILE...
import { readFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import validator from "gltf-validator";

const reports = {};
for (const path of process.argv.slice(2)) {
  const bytes = new Uint8Array(await readFile(path));
  reports[path] = await validator.validateBytes(bytes, {
    uri: path,
    maxIssues: 0,
    externalResourceFunction: async (uri) => new Uint8Array(await readFile(join(dirname(path), decodeURIComponent(uri)))),
  });
}
console.log(JSON.stringify(reports));

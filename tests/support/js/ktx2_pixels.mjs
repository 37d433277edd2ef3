// Decodes KTX2 files with the Basis transcoder that comes with three.js and prints what they hold, as JSON.
// usage: node ktx2_pixels.mjs < request
// request: [base64]
// answer: [{"width", "height", "levels", "uastc", "srgb", "pixels": base64 of the first level's RGBA}]
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { dirname, join } from "node:path";

const require = createRequire(import.meta.url);
const script = require.resolve("three/examples/jsm/libs/basis/basis_transcoder.js"), folder = dirname(script);
const BASIS = new Function("require", "__dirname", `${readFileSync(script, "utf8")}; return BASIS;`)(require, folder); // a script of pages, and no module
const basis = await BASIS({ wasmBinary: readFileSync(join(folder, "basis_transcoder.wasm")) });
basis.initializeBasis();
const RGBA32 = 13, SRGB = 2;
const answers = JSON.parse(readFileSync(0, "utf8")).map((text) => {
  const data = new Uint8Array(Buffer.from(text, "base64"));
  const file = new basis.KTX2File(data);
  if (!file.isValid() || !file.startTranscoding()) throw new Error("not a KTX2 file that can be decoded");
  const pixels = new Uint8Array(file.getImageTranscodedSizeInBytes(0, 0, 0, RGBA32));
  if (!file.transcodeImage(pixels, 0, 0, 0, RGBA32, 0, -1, -1)) throw new Error("can't be decoded");
  const view = new DataView(data.buffer, data.byteOffset);
  return {
    width: file.getWidth(), height: file.getHeight(), levels: file.getLevels(), uastc: file.isUASTC(),
    srgb: data[view.getUint32(48, true) + 14] === SRGB, // the data format descriptor's transfer function
    pixels: Buffer.from(pixels).toString("base64"),
  };
});
console.log(JSON.stringify(answers));

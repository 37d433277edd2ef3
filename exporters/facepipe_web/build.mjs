// Bundles the sources into dist/: facepipe.js, the runtime for other people's pages (three and onnxruntime-web stay
// imports), person.js, of it what needs neither, and viewer and studio with all that they need, licences of the packages among it.
import { cpSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { basename, join } from "node:path";
import { execFileSync } from "node:child_process";
import { build } from "esbuild";

const out = process.argv[2] ?? "dist";
const packages = "node_modules";
const bundled = ["three", "onnxruntime-web", "onnxruntime-common"];
const shared = { bundle: true, format: "esm", target: "es2022", minify: true, legalComments: "none", logLevel: "warning" };

rmSync(out, { recursive: true, force: true });
mkdirSync(join(out, "licences"), { recursive: true });
const entries = { facepipe: "src/runtime/index.ts", person: "src/runtime/persons.ts" };
await build({ ...shared, entryPoints: entries, outdir: out, packages: "external" });
await build({
  ...shared,
  entryPoints: { viewer: "src/viewer/main.ts", studio: "src/studio/main.ts" },
  outdir: out,
  splitting: true,
  conditions: ["onnxruntime-web-use-extern-wasm"],
  chunkNames: "chunk-[hash]",
});
for (const name of ["viewer/index.html", "viewer/style.css", "studio/studio.html", "studio/studio.css"]) {
  cpSync(join("src", name), join(out, basename(name)));
}
// the plain WebAssembly build alone: the viewer does not ask for WebGPU, whose build is twice as large
for (const suffix of ["mjs", "wasm"]) {
  const name = `ort-wasm-simd-threaded.${suffix}`;
  cpSync(join(packages, "onnxruntime-web/dist", name), join(out, name));
}
const typescript = join(packages, "typescript/bin/tsc");
const declarations = ["--declaration", "--emitDeclarationOnly", "--outDir", join(out, "types")];
execFileSync(process.execPath, [typescript, ...declarations], { stdio: "inherit" });
// onnxruntime's packages name their licence and bring no text
for (const name of bundled) {
  const { version, license } = JSON.parse(readFileSync(join(packages, name, "package.json"), "utf8"));
  const text = read(join(packages, name, "LICENSE")) || read("licences/onnxruntime-web.txt");
  writeFileSync(join(out, "licences", `${name}.txt`), `${name} ${version}, ${license}\n\n${text}`);
}
cpSync("licences/meshoptimizer.txt", join(out, "licences", "meshoptimizer.txt")); // its decoder comes with three

function read(path) {
  try {
    return readFileSync(path, "utf8");
  } catch {
    return "";
  }
}

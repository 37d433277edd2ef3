// Rebuilds persons with the runtime's person.js, in no browser: node person_points.mjs PERSON_JS BASIS CASES [OUT]
// CASES: uint32 length and bytes of each payload; of each basis where BASIS is -. Prints as JSON for each the sum of its numbers
// without signs, millimetres, or what is wrong. OUT gets points, then joints, of the persons one after another: float64 x y z.
import { openSync, readFileSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [script, basisFile, casesFile, outFile] = process.argv.slice(2);
const { FaceError, jointPlaces, parsePerson, readBasis, rebuilt } = await import(pathToFileURL(script));
const buffer = (file) => Uint8Array.from(readFileSync(file)).buffer;
const basis = basisFile === "-" ? null : await readBasis(buffer(basisFile), "basis");
const out = outFile && openSync(outFile, "w");
const found = [];
const cases = buffer(casesFile);
for (let at = 0; at < cases.byteLength; ) {
  const length = new DataView(cases).getUint32(at, true);
  found.push(await verdict(cases.slice(at + 4, at + 4 + length)));
  at += 4 + length;
}
console.log(JSON.stringify(found));

async function verdict(bytes) {
  try {
    if (!basis) return sum((await readBasis(bytes, "basis")).mean);
    const points = rebuilt(basis, parsePerson(bytes, "person"));
    const joints = jointPlaces(basis, points);
    if (out) for (const one of [points, joints]) writeSync(out, new Uint8Array(one.buffer));
    return sum(points);
  } catch (error) {
    if (!(error instanceof FaceError)) throw error; // a bug, and no line for users
    return error.message;
  }
}

function sum(numbers) {
  return numbers.reduce((total, value) => total + Math.abs(value), 0);
}

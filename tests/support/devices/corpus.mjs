// What the runtime's person.js makes of the cases of tests/support/person_corpus.py: node corpus.mjs PERSON_JS ...
//
//   persons BASIS CASES   a line a case: "ok", and figures of the points and joints, with turns; or "no"
//   bases CASES           the same of bases: of all of their modes, and a step of 1 mm of all numbers of joints
//   poses CASES           the same of bone coefficients: nine numbers a joint and frame, then times
//   points BASIS FPB OUT  points and joints as float64
//   lids BASIS FPB OUT    offsets of the shapes of lids as float64, and prints their names and weights
//   time BASIS FPB        milliseconds of processor time: the basis, then a person and its lids, first and in the middle of 21
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [script, what, ...files] = process.argv.slice(2);
const { FaceError, fittedLids, jointPlaces, jointTurns, parsePayload, parsePerson, readBasis, rebuilt, shapesTurn } = await import(pathToFileURL(script));
const read = (file) => Uint8Array.from(readFileSync(file)).buffer;
const processor = () => process.cpuUsage().user / 1e3 + process.cpuUsage().system / 1e3;

if (what === "bases") {
  // as on a page without SHA-256: digests are the names that others give
  Object.defineProperty(globalThis, "crypto", { value: undefined });
  await judge(files[0], async (bytes) => {
    const basis = await readBasis(bytes, "case");
    const joints = { step: 1, numbers: new Array(basis.identityJoints?.places.length * 3 || 0).fill(1) };
    const modes = basis.modes.map(() => 1);
    const who = { where: "case", basis: basis.digest, modes, placement: null, parts: [], points: [], joints, rig: null };
    const points = rebuilt(basis, who);
    const eyes = basis.lids?.eyes ?? [];
    const numbers = eyes.flatMap((eye) => [eye.centre, eye.shares, eye.balls, eye.stretches, eye.ends, eye.ways]);
    tryLids(basis, points);
    return [points, [jointPlaces(basis, points), basis.lids?.reach ?? [], ...numbers, jointTurns(basis, null), shapesTurn(null)].flatMap((one) => Array.from(one))];
  });
} else if (what === "poses") {
  await judge(files[0], (bytes) => {
    const { frames, times } = parsePayload(bytes, "case");
    return [frames.flatMap((frame) => Array.from(frame)), Array.from(times ?? [])];
  });
} else {
  const before = processor();
  const basis = await readBasis(read(files[0]), files[0]);
  const loaded = processor() - before;
  const person = (bytes) => {
    const who = parsePerson(bytes, "case");
    const points = rebuilt(basis, who);
    const joints = [jointPlaces(basis, points, who.rig), jointTurns(basis, who.rig), shapesTurn(who.rig)];
    return [who, points, Float64Array.from(joints.flatMap((one) => Array.from(one)))];
  };
  if (what === "persons") {
    await judge(files[1], (bytes) => {
      const [who, ...both] = person(bytes);
      tryLids(basis, both[0], who);
      return both;
    });
  } else if (what === "points") write(person(read(files[1])).slice(1));
  else if (what === "lids") {
    const [who, points] = person(read(files[1]));
    const shapes = fittedLids(basis, points, who);
    for (const { name, weight } of shapes) console.log(name, weight);
    write(shapes.map((shape) => shape.offsets));
  } else {
    const timed = (of) => {
      const took = Array.from({ length: 21 }, () => {
        const start = processor();
        of();
        return processor() - start;
      });
      return [took[0], took.sort((a, b) => a - b)[10]];
    };
    const rebuild = timed(() => person(read(files[1])));
    const [, points] = person(read(files[1]));
    console.log([loaded, ...rebuild, ...timed(() => fittedLids(basis, points))].map((one) => one.toFixed(1)).join(" "));
  }
}

function write(arrays) {
  writeFileSync(files[2], Buffer.concat(arrays.map((one) => new Uint8Array(one.buffer))));
}

/** Lids of whatever points: offsets, or one line. */
function tryLids(basis, points, who = null) {
  try {
    fittedLids(basis, points, who);
  } catch (error) {
    if (!(error instanceof FaceError)) throw error;
  }
}

/** A line for each case: uint32 length, bytes, one after another. */
async function judge(file, make) {
  const cases = read(file);
  for (let at = 0, length; at < cases.byteLength; at += 4 + length) {
    length = new DataView(cases).getUint32(at, true);
    try {
      console.log(["ok", ...(await make(cases.slice(at + 4, at + 4 + length))).flatMap(figures)].join(" "));
    } catch (error) {
      if (!(error instanceof FaceError) || error.message.includes("\n")) throw error; // a bug, and no line for users
      console.log("no");
    }
  }
}

function figures(values) {
  let [size, weighted] = [0, 0];
  values.forEach((value, i) => {
    size += Math.abs(value);
    weighted += value * (1 + (i % 7));
  });
  return [size, weighted].map((one) => (one / Math.max(values.length, 1)).toPrecision(9));
}

/** The file of a basis (.fpbasis), which persons are relative to: docs/files.md, "A basis (.fpbasis)". */
import { Bytes, hex, readSections, type Section, shortHash } from "./bytes";
import { FaceError } from "./errors";
import { type IdentityJoints, readIdentityJoints } from "./identity_joints";
import { type LidTables, readLids } from "./lid_tables";

/** Points of a level, and of which of coarser levels they are predicted. */
export interface Level {
  rows: Int32Array;
  /** neighbours of a point, 0 in the coarsest level */
  width: number;
  /** `width` for each row */
  neighbours: Int32Array;
  /** of them, 64ths */
  shares: Int8Array;
}

/** Runs of points that keep their shape, first and the one after the last. */
export interface RigidPart {
  /** moved after the modes; else it is the mean's */
  withModes: boolean;
  runs: [number, number][];
}

/** A joint, which is where the sum of shares times points is. */
export interface JointPlace {
  path: string;
  points: number[];
  shares: number[];
}

/** A mean face of n points and its modes: all meshes' points one after another, millimetres, Y up. */
export interface Basis {
  name: string;
  /** hexadecimal; persons name it */
  digest: string;
  meshes: { name: string; points: number }[];
  count: number;
  /** all x, all y, all z */
  mean: Float64Array;
  /** the coarsest first; points in none have no offsets */
  levels: Level[];
  /** millimetres */
  step: number;
  /** of each mode steps of all x, all y, all z, a standard deviation */
  modes: Int16Array[];
  parts: RigidPart[];
  joints: JointPlace[];
  /** those that are who somebody is; they pose nothing */
  identityJoints: IdentityJoints | null;
  /** what blinks, looks and squints are fitted by */
  lids: LidTables | null;
}

const MAGIC = 0x41425046; // FPBA
const HEADER = 20;
const MOST_BYTES = 2 ** 28;
const MOST_POINTS = 2 ** 20;
const MOST_PARTS = 16;
const FINEST = 1e6; // places in a millimetre
const WHOLE = 64;
const [NAME, MESHES, MEAN, LEVELS, MODES, PARTS, JOINTS, IDENTITY_JOINTS, LIDS] = [1, 2, 3, 4, 5, 6, 7, 8, 9];

/**
 * The basis in `bytes`. Its digest is computed again where the page is from https or localhost; elsewhere the browser
 * has no SHA-256, and the checksum of the zlib stream must do.
 * @param where its name for messages
 * @throws FaceError no basis, a damaged one, or numbers that don't fit each other
 */
export async function readBasis(bytes: ArrayBuffer, where = "basis"): Promise<Basis> {
  const view = new DataView(bytes);
  if (bytes.byteLength < HEADER || view.getUint32(0, true) !== MAGIC) {
    throw new FaceError(where, "no basis, expected a file that begins with FPBA");
  }
  const [version, flags, size] = [view.getUint16(4, true), view.getUint16(6, true), view.getUint32(16, true)];
  if (version !== 1 || flags) throw new FaceError(where, `version ${version}, flags ${flags}, expected 1 without flags`);
  if (size > MOST_BYTES) throw new FaceError(where, `${size} bytes, expected at most ${MOST_BYTES}`);
  const digest = hex(new Uint8Array(bytes, 8, 8));
  const body = await inflated(new Uint8Array(bytes, HEADER), size, where);
  const hash = await shortHash(body);
  if (hash !== null && hash !== digest) throw new FaceError(where, "is damaged: its digest differs");
  const sections = readSections(body, where);
  const of = (kind: number) => new Bytes(sections.get(kind)?.data ?? new Uint8Array(0), `${where} -> section of kind ${kind}`);
  for (const { kind, required } of sections.values()) {
    if (required && kind > LIDS) throw new FaceError(where, `section of kind ${kind}, which this version of facepipe does not know`);
  }
  for (const kind of [NAME, MESHES, MEAN, LEVELS]) {
    if (!sections.has(kind)) throw new FaceError(where, `no section of kind ${kind}, expected one`);
  }
  return { digest, ...content(sections, of) };
}

function content(sections: Map<number, Section>, of: (kind: number) => Bytes): Omit<Basis, "digest"> {
  const name = of(NAME).text(of(NAME).left);
  const meshes = readMeshes(of(MESHES));
  const count = meshes.reduce((sum, mesh) => sum + mesh.points, 0);
  if (!(count > 0 && count <= MOST_POINTS)) throw of(MESHES).wrong(`${count} points, expected 1 to ${MOST_POINTS}`);
  const mean = readMean(of(MEAN), count);
  const levels = readLevels(of(LEVELS), count);
  const { step, modes } = sections.has(MODES) ? readModes(of(MODES), count, levels) : { step: 0, modes: [] };
  const [parts, joints] = [readParts(of(PARTS), count), readJoints(of(JOINTS), count)];
  const identityJoints = sections.has(IDENTITY_JOINTS) ? readIdentityJoints(of(IDENTITY_JOINTS), count) : null;
  const lids = sections.has(LIDS) ? readLids(of(LIDS), mean, joints.length) : null;
  return { name, meshes, count, mean, levels, step, modes, parts, joints, identityJoints, lids };
}

/** A zlib stream as so many bytes; it is left as soon as there are more. */
async function inflated(data: Uint8Array<ArrayBuffer>, size: number, where: string): Promise<Uint8Array<ArrayBuffer>> {
  const body = new Uint8Array(size);
  let at = 0;
  try {
    const reader = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
    for (let { value, done } = await reader.read(); !done; { value, done } = await reader.read()) {
      if (at + value!.length > size) throw await reader.cancel().then(() => new RangeError("more bytes than it counts"));
      body.set(value!, at);
      at += value!.length;
    }
  } catch (error) {
    throw new FaceError(where, `is damaged: ${String((error as Error).message).split("\n")[0]}`);
  }
  if (at !== size) throw new FaceError(where, `is damaged, expected ${size} bytes of sections`);
  return body;
}

function readMeshes(bytes: Bytes): Basis["meshes"] {
  const found: Basis["meshes"] = [];
  while (bytes.left) found.push({ name: bytes.name(), points: bytes.uint32() });
  return found;
}

function readMean(bytes: Bytes, count: number): Float64Array {
  bytes.take(32); // SHA-256 of the topology: a GLB has triangles, and does not tell it
  const grid = bytes.uint32();
  if (!(grid >= 1 && grid <= FINEST)) throw bytes.wrong(`${grid} places in a millimetre, expected 1 to ${FINEST}`);
  const places = Float64Array.from(bytes.planes(3 * count));
  bytes.end();
  for (let i = 0; i < places.length; i++) if (i % count) places[i] += places[i - 1];
  return places.map((place) => place / grid);
}

function readLevels(bytes: Bytes, count: number): Level[] {
  const finer = bytes.byte();
  const sizes = bytes.many(finer + 1, 4, bytes.uint32);
  const widths = [0, ...bytes.many(finer, 1, bytes.byte)];
  const total = sizes.reduce((sum, size) => sum + size, 0);
  if (total > count) throw bytes.wrong(`${total} points of levels, expected at most ${count}`);
  const offsets = bytes.planes(total);
  const near = bytes.planes(sizes.reduce((sum, size, i) => sum + size * widths[i], 0));
  const shares = new Int8Array(bytes.take(near.length));
  bytes.end();
  const known = new Uint8Array(count);
  let [first, place] = [0, 0];
  return sizes.map((size, number) => {
    const width = widths[number];
    const rows = offsets.slice(first, first + size);
    for (let i = 1; i < size; i++) rows[i] += rows[i - 1];
    const level = { rows, width, neighbours: new Int32Array(size * width), shares: new Int8Array(size * width) };
    for (let k = 0; k < width; k++) {
      for (let i = 0; i < size; i++, place++) {
        level.neighbours[i * width + k] = rows[i] + near[place];
        level.shares[i * width + k] = shares[place];
      }
    }
    if (number) checkNeighbours(level, known, bytes);
    for (let i = 0; i < size; i++) {
      if (!(rows[i] >= 0 && rows[i] < count) || (i && rows[i] <= rows[i - 1]) || known[rows[i]]) {
        throw bytes.wrong("points of a level that don't ascend, or are in two, expected each once");
      }
    }
    if (!size) throw bytes.wrong("a level without points");
    for (const row of rows) known[row] = 1;
    first += size;
    return level;
  });
}

function checkNeighbours({ neighbours, shares, width }: Level, known: Uint8Array, bytes: Bytes): void {
  if (!width || !neighbours.every((point) => known[point] === 1)) {
    throw bytes.wrong("neighbours that are in no coarser level, expected points that are");
  }
  for (let i = 0; i < shares.length; i += width) {
    let sum = 0;
    for (let k = i; k < i + width; k++) sum += shares[k];
    if (sum !== WHOLE) throw bytes.wrong(`shares of neighbours whose sum is ${sum}, expected ${WHOLE}`);
  }
}

function readModes(bytes: Bytes, count: number, levels: Level[]): { step: number; modes: Int16Array[] } {
  const modes = bytes.uint16();
  const step = bytes.float32();
  if (!(step > 0 && step <= 1e3) || !modes) throw bytes.wrong(`${modes} modes in steps of ${step} mm, expected some in steps above 0, at most 1000`);
  const numbers = 3 * count * modes;
  const data = bytes.take(2 * numbers);
  bytes.end();
  const levelled = new Set(levels.flatMap((level) => Array.from(level.rows)));
  const others = Int32Array.from({ length: count }, (_, i) => i).filter((i) => !levelled.has(i));
  const found = Array.from({ length: modes }, () => new Int16Array(3 * count)); // whose numbers wrap as the file's
  const residual = (at: number): number => {
    const folded = data[at] | (data[numbers + at] << 8);
    return (folded >> 1) ^ -(folded & 1);
  };
  for (let plane = 0, at = 0; plane < 3 * modes; plane++) {
    const axis = (plane % 3) * count;
    const own = found[(plane / 3) | 0].subarray(axis, axis + count);
    for (const { rows, neighbours, shares, width } of levels) {
      for (let i = 0; i < rows.length; i++, at++) {
        let sum = width ? WHOLE / 2 : 0;
        for (let k = i * width; k < (i + 1) * width; k++) sum += shares[k] * own[neighbours[k]];
        own[rows[i]] = (sum >> 6) + residual(at);
      }
    }
    for (let i = 0, before = 0; i < others.length; i++, at++) before = own[others[i]] = (before + residual(at)) << 16 >> 16;
  }
  return { step, modes: found };
}

function readParts(bytes: Bytes, count: number): RigidPart[] {
  const parts: RigidPart[] = [];
  while (bytes.left) {
    if (parts.length === MOST_PARTS) throw bytes.wrong(`more than ${MOST_PARTS} parts`);
    const [withModes, length] = [bytes.byte(), bytes.uint16()];
    const ends = bytes.many(2 * length, 4, bytes.uint32);
    const ascend = ends.every((end, i) => !i || (i % 2 ? end > ends[i - 1] : end >= ends[i - 1]));
    if (withModes > 1 || !length || !ascend) throw bytes.wrong("runs of a part that don't ascend, expected each point once");
    if (ends[ends.length - 1] > count) throw bytes.wrong(`points to ${ends[ends.length - 1]}, expected at most ${count}`);
    parts.push({ withModes: withModes === 1, runs: Array.from({ length }, (_, i) => [ends[2 * i], ends[2 * i + 1]]) });
  }
  return parts;
}

function readJoints(bytes: Bytes, count: number): JointPlace[] {
  const joints: JointPlace[] = [];
  while (bytes.left) {
    const path = bytes.name();
    const size = bytes.byte();
    const points = bytes.many(size, 4, bytes.uint32);
    const shares = bytes.many(size, 4, bytes.float32);
    if (!size || !points.every((point) => point < count) || !shares.every(Number.isFinite)) {
      throw bytes.wrong(`joint '${path}' of points that are not there, expected at most ${count}`);
    }
    joints.push({ path, points, shares });
  }
  return joints;
}

/** Persons as payloads (.fpb, version 2), and their points: docs/files.md, "A person (.fpb)". */
import type { Basis, RigidPart } from "./basis";
import { Bytes, crc32, hex, readSections } from "./bytes";
import { FaceError } from "./errors";
import { addIdentityJoints, type JointSteps, readJointSteps } from "./identity_joints";
import { motionOf } from "./motion";
import { type PersonRig, readRig } from "./person_rig";
import { addOffsets } from "./point_levels";

export interface Person {
  /** its name for messages */
  where: string;
  /** hexadecimal digest of the basis */
  basis: string;
  /** weights of the basis's first modes, in standard deviations */
  modes: number[];
  /** of the whole face: tx ty tz in millimetres, x y z of a unit quaternion, logarithm of the scale */
  placement: number[] | null;
  /** the same of parts that keep their shape */
  parts: number[][];
  /** section of offsets, by levels */
  points: Uint8Array;
  /** of identity joints */
  joints: JointSteps | null;
  /** how joints rest and shapes go, where not as points and basis have them */
  rig: PersonRig | null;
  /** section of pictures of materials */
  pictures: Uint8Array;
  /** bone coefficients on top, for `parsePayload` */
  coefficients: ArrayBuffer | null;
  /** kinds of sections that are left out */
  skipped: number[];
}

const MAGIC = 0x43425046; // FPBC
const VERSION = 2;
const HEADER = 8;
const [BASIS, MODES, PLACEMENT, MOVED_PARTS, TURNED_PARTS, POINTS, JOINTS] = [1, 2, 3, 4, 5, 6, 7];
const [PICTURES, COEFFICIENTS] = [10, 11]; // which may be left out
const RIG = 12;
const DIGEST = 8; // bytes
const MOST_MODES = 4096;
const MOST_PARTS = 16;
const LARGEST = [1e4, 1e4, 1e4, 1, 1, 1, 3]; // of a placement
const LARGEST_WEIGHT = 100; // standard deviations
const ROUNDED = 1.002; // square of a half turn's axis in float16, at most

/** Whether a payload is of a person, and not of bone coefficients. */
export function isPerson(bytes: ArrayBuffer): boolean {
  const view = new DataView(bytes);
  return bytes.byteLength >= HEADER && view.getUint32(0, true) === MAGIC && view.getUint16(4, true) === VERSION;
}

/**
 * The person in `bytes`.
 * @param where its name for messages
 * @throws FaceError no person, a damaged one, a section that must be known, or numbers beyond limits
 */
export function parsePerson(bytes: ArrayBuffer, where = "person"): Person {
  if (!isPerson(bytes)) throw new FaceError(where, `no person, expected a file that begins with FPBC and the version ${VERSION}`);
  const [view, end] = [new DataView(bytes), bytes.byteLength - 4];
  if (end < HEADER || crc32(new Uint8Array(bytes, 0, end)) !== view.getUint32(end, true)) {
    throw new FaceError(where, "is damaged: its CRC differs");
  }
  if (view.getUint16(6, true)) throw new FaceError(where, `flags ${view.getUint16(6, true)}, expected none`);
  const sections = readSections(new Uint8Array(bytes, HEADER, end - HEADER), where);
  const skipped = [...sections.values()].filter(({ kind }) => kind > JOINTS && kind !== RIG);
  for (const { kind, required } of skipped) {
    if (required) throw new FaceError(where, `section of kind ${kind}, which this version of facepipe does not know`);
  }
  const digest = sections.get(BASIS)?.data;
  if (!digest) throw new FaceError(where, "no person: it names no basis");
  if (digest.length !== DIGEST) throw new FaceError(`${where} -> basis`, `${digest.length} bytes, expected ${DIGEST}`);
  if (sections.has(MOVED_PARTS) && sections.has(TURNED_PARTS)) {
    throw new FaceError(where, "parts with turns and without, expected one of them");
  }
  const rows = (kind: number, size: number, each: number, most: number, name: string): number[][] => {
    const data = sections.get(kind)?.data;
    const count = (data?.length ?? 0) / (size * each);
    if (!data) return [];
    if (!Number.isInteger(count) || count < 1 || count > most) {
      throw new FaceError(`${where} -> ${name}`, `${data.length} bytes, expected 1 to ${most} times ${size * each}`);
    }
    const own = new Bytes(data, where);
    return Array.from({ length: count }, () => own.many(each, size, size === 4 ? own.float32 : own.float16));
  };
  const still = rows(MOVED_PARTS, 2, 4, MOST_PARTS, "parts").map(([x, y, z, scale]) => [x, y, z, 0, 0, 0, scale]);
  const [joints, trail] = [sections.get(JOINTS)?.data, `${where} -> joints`];
  return {
    where,
    basis: hex(digest),
    modes: checkedModes(rows(MODES, 2, 1, MOST_MODES, "modes").flat(), where),
    placement: checkedMoves(rows(PLACEMENT, 4, 7, 1, "placement"), where)[0] ?? null,
    parts: checkedMoves([...still, ...rows(TURNED_PARTS, 2, 7, MOST_PARTS, "parts")], where),
    points: sections.get(POINTS)?.data ?? new Uint8Array(0),
    joints: joints ? readJointSteps(new Bytes(joints, trail), trail) : null,
    rig: sections.has(RIG) ? checkedRig(sections.get(RIG)!.data, `${where} -> rig`) : null,
    pictures: sections.get(PICTURES)?.data ?? new Uint8Array(0),
    coefficients: sections.has(COEFFICIENTS) ? Uint8Array.from(sections.get(COEFFICIENTS)!.data).buffer : null,
    skipped: skipped.map(({ kind }) => kind).filter((kind) => kind !== PICTURES && kind !== COEFFICIENTS),
  };
}

/**
 * The points of a person on its basis: 3 numbers each, millimetres, Y up.
 * @throws FaceError a person of another basis, with more modes, more joints or other parts, or points that are not the basis's
 */
export function rebuilt(basis: Basis, person: Person): Float64Array {
  const { where, modes, placement, parts, points: offsets, joints } = person;
  if (person.basis !== basis.digest) {
    throw new FaceError(where, `a person on another basis (${person.basis}), expected ${basis.digest} of ${basis.name}`);
  }
  if (modes.length > basis.modes.length) {
    throw new FaceError(where, `${modes.length} modes, expected at most the ${basis.modes.length} of its basis`);
  }
  if (parts.length && parts.length !== basis.parts.length) {
    throw new FaceError(where, `${parts.length} parts, expected the ${basis.parts.length} of its basis or none`);
  }
  const [own, count] = [basis.identityJoints, (joints?.numbers.length ?? 0) / 9];
  const most = (own?.places.length ?? 0) / 3;
  if (count > most) throw new FaceError(where, `${count} joints, expected at most the ${most} of its basis`);
  const rests = person.rig?.rests.length ?? 0;
  if (rests > basis.joints.length) throw new FaceError(where, `${rests} joints at rest, expected at most the ${basis.joints.length} of its basis`);
  const [points, mean] = [interleaved(shaped(basis, modes), basis.count), interleaved(basis.mean, basis.count)];
  if (own && joints) addIdentityJoints(own, joints, mean, points);
  const all: RigidPart["runs"] = [[0, basis.count]];
  if (placement) for (const one of [points, mean]) place(placement, one, one, all, [0, 0, 0]);
  parts.forEach((moved, i) => {
    const { runs, withModes } = basis.parts[i];
    const from = withModes ? points : mean;
    place(moved, from, points, runs, center(from, runs));
  });
  if (offsets.length) addOffsets(basis, offsets, points, `${where} -> points`);
  return points;
}

/** Where the basis's joints rest, 3 numbers each: by a person's points, and the person's rig if there is one. */
export function jointPlaces(basis: Basis, points: Float64Array, rig: PersonRig | null = null): Float64Array {
  const found = new Float64Array(3 * basis.joints.length);
  basis.joints.forEach((joint, i) => {
    joint.points.forEach((point, k) => {
      for (let axis = 0; axis < 3; axis++) found[3 * i + axis] += joint.shares[k] * points[3 * point + axis];
    });
    for (let axis = 0; axis < 3; axis++) found[3 * i + axis] += rig?.rests[i]?.[4 * axis + 3] ?? 0;
  });
  return found;
}

/** How the basis's joints are turned at rest: 9 numbers each, rows of a rotation. */
export function jointTurns(basis: Basis, rig: PersonRig | null): Float64Array {
  const still = motionOf([0, 0, 0, 0, 0, 0, 1, 1, 1]);
  return Float64Array.from(basis.joints.flatMap((_, i) => (rig?.rests[i] ?? still).filter((_, k) => k % 4 < 3)));
}

/** What offsets of shapes are multiplied by, but those of lids: 9 numbers, rows. */
export function shapesTurn(rig: PersonRig | null): number[] {
  const columns = Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, 1);
  if (rig) place([0, 0, 0, ...rig.shapes], columns, columns, [[0, 3]], [0, 0, 0]);
  return Array.from(columns, (_, i) => columns[3 * (i % 3) + ((i / 3) | 0)]);
}

function checkedRig(data: Uint8Array, where: string): PersonRig {
  const rig = readRig(new Bytes(data, where), where);
  checkedMoves([[0, 0, 0, ...rig.shapes]], `${where} -> shapes`);
  return rig;
}

const BLOCK = 4096; // numbers of a sum that stay in the cache
const ABREAST = 8; // modes that are added at once, in less than half of the time that one by one takes

/** `mean + sum_k w_k modes_k` */
function shaped({ mean, modes, step }: Basis, weights: number[]): Float64Array {
  const points = mean.slice();
  const scales = weights.map((weight) => weight * step);
  const own = modes.slice(0, weights.length);
  for (; own.length % ABREAST; scales.push(0)) own.push(own[0]);
  for (let start = 0; start < points.length; start += BLOCK) {
    const end = Math.min(start + BLOCK, points.length);
    for (let k = 0; k < own.length; k += ABREAST) add(points, start, end, own.slice(k), scales.slice(k));
  }
  return points;
}

function add(points: Float64Array, start: number, end: number, [a, b, c, d, e, f, g, h]: Int16Array[], [p, q, r, s, t, u, v, w]: number[]): void {
  for (let i = start; i < end; i++) points[i] += p * a[i] + q * b[i] + r * c[i] + s * d[i] + t * e[i] + u * f[i] + v * g[i] + w * h[i];
}

function interleaved(planes: Float64Array, count: number): Float64Array {
  const found = new Float64Array(3 * count);
  for (let axis = 0; axis < 3; axis++) for (let i = 0; i < count; i++) found[3 * i + axis] = planes[axis * count + i];
  return found;
}

function center(points: Float64Array, runs: RigidPart["runs"]): number[] {
  const sum = [0, 0, 0];
  let count = 0;
  for (const [start, end] of runs) {
    for (let i = 3 * start; i < 3 * end; i++) sum[i % 3] += points[i];
    count += end - start;
  }
  return sum.map((one) => one / count);
}

/** `to = scale R (from - about) + about + t` of runs of points. */
function place(placement: number[], from: Float64Array, to: Float64Array, runs: RigidPart["runs"], about: number[]): void {
  const [tx, ty, tz, x, y, z, logarithm] = placement;
  const w = Math.sqrt(Math.max(1 - x * x - y * y - z * z, 0));
  const length = x * x + y * y + z * z + w * w; // above 1 where a half turn was rounded
  const [scale, s] = [Math.exp(logarithm), 2 / length];
  const turn = [
    [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
    [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
    [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
  ];
  for (const [start, end] of runs) {
    for (let i = 3 * start; i < 3 * end; i += 3) {
      const [a, b, c] = [from[i] - about[0], from[i + 1] - about[1], from[i + 2] - about[2]];
      to[i] = scale * (turn[0][0] * a + turn[0][1] * b + turn[0][2] * c) + about[0] + tx;
      to[i + 1] = scale * (turn[1][0] * a + turn[1][1] * b + turn[1][2] * c) + about[1] + ty;
      to[i + 2] = scale * (turn[2][0] * a + turn[2][1] * b + turn[2][2] * c) + about[2] + tz;
    }
  }
}

function checkedModes(modes: number[], where: string): number[] {
  const off = modes.findIndex((weight) => !(Math.abs(weight) <= LARGEST_WEIGHT));
  if (off >= 0) throw new FaceError(`${where} -> mode ${off}`, `${modes[off]}, expected at most ${LARGEST_WEIGHT} standard deviations`);
  return modes;
}

function checkedMoves(moves: number[][], where: string): number[][] {
  moves.forEach((move, i) => {
    const turn = move[3] ** 2 + move[4] ** 2 + move[5] ** 2;
    if (!move.every((value, k) => Math.abs(value) <= LARGEST[k]) || turn > ROUNDED) {
      throw new FaceError(`${where} -> placement ${i}`, `${move.join(" ")}, expected a move, part of a quaternion, a scale`);
    }
  });
  return moves;
}

/** Bone coefficients of a device payload (.fpb; docs/files.md, "Bone coefficients"). */
import { crc32, half, hex, shortHash } from "./bytes";
import { FaceError } from "./errors";

export interface Payload {
  jointCount: number;
  /** first 8 bytes of the SHA-256 of the joint paths, hexadecimal */
  jointsHash: string;
  /** metres in one unit of the translations */
  metersPerUnit: number;
  /** seconds of each frame; null: poses without times */
  times: Float32Array | null;
  /** per frame 9 numbers a joint: tx ty tz rx ry rz sx sy sz, rest is 0 0 0 0 0 0 1 1 1 */
  frames: Float32Array[];
}

const FLOAT32 = 1;
const FRAMES = 2;
const TIMES = 4;
const SPARSE = 8;
const HEADER = 32;
const LARGEST = 2 ** 100;
const MOST = 2 ** 27;

/**
 * The payload in `bytes`.
 * @param where its name for messages
 * @throws FaceError no payload, a damaged one, or numbers that are not finite
 */
export function parsePayload(bytes: ArrayBuffer, where = "payload"): Payload {
  const view = new DataView(bytes);
  const head = readHeader(view, where);
  const { joints, frames, stored, flags, size, values, mask } = head;
  const places = flags & SPARSE ? maskPlaces(new Uint8Array(bytes, mask), joints) : Array.from({ length: joints }, (_, i) => i);
  if (places.length !== stored) refuse(where, `mask of ${places.length} joints, expected ${stored}`);
  const found: Float32Array[] = [];
  for (let frame = 0, at = values; frame < frames; frame++) {
    const own = Float32Array.from({ length: 9 * joints }, (_, i) => (i % 9 > 5 ? 1 : 0));
    for (const joint of places) {
      for (let channel = 0; channel < 9; channel++, at += size) {
        const value = size === 4 ? view.getFloat32(at, true) : half(view.getUint16(at, true));
        if (!(Math.abs(value) <= LARGEST)) refuse(where, "NaN, infinity or a number above 2^100, expected finite ones");
        own[9 * joint + channel] += value;
      }
    }
    found.push(own);
  }
  return {
    jointCount: joints,
    jointsHash: hex(new Uint8Array(bytes, 24, 8)),
    metersPerUnit: view.getFloat32(20, true),
    times: flags & TIMES ? ascending(new Float32Array(bytes.slice(HEADER, values)), where) : null,
    frames: found,
  };
}

interface Head {
  joints: number;
  frames: number;
  stored: number;
  flags: number;
  size: number;
  values: number;
  mask: number;
}

function readHeader(view: DataView, where: string): Head {
  const length = view.byteLength;
  if (length < 4 || view.getUint32(0, true) !== 0x43425046) refuse(where, "no bone coefficients, expected a file that begins with FPBC");
  if (length < HEADER + 4) refuse(where, `${length} bytes, expected at least ${HEADER + 4}`);
  if (view.getUint16(4, true) !== 1) refuse(where, `version ${view.getUint16(4, true)}, expected 1`);
  const [flags, joints, frames, stored] = [view.getUint16(6, true), ...[8, 12, 16].map((at) => view.getUint32(at, true))];
  const size = flags & FLOAT32 ? 4 : 2;
  const values = HEADER + (flags & TIMES ? 4 * frames : 0);
  const mask = values + 9 * frames * stored * size;
  const end = mask + (flags & SPARSE ? Math.ceil(joints / 8) : 0);
  if (length !== end + 4) refuse(where, `${length} bytes, expected ${end + 4} for what its header counts`);
  if (crc32(new Uint8Array(view.buffer, view.byteOffset, end)) !== view.getUint32(end, true)) refuse(where, "is damaged: its CRC differs");
  const unit = view.getFloat32(20, true);
  const sound =
    flags < 16 && (!(flags & TIMES) || flags & FRAMES) && (flags & FRAMES || frames === 1) && frames > 0 && stored > 0 &&
    stored <= joints && (flags & SPARSE || stored === joints) && 9 * frames * joints <= MOST && unit >= 1e-9 && unit <= 1e9;
  if (!sound) refuse(where, `flags ${flags}, ${frames} frames of ${stored} among ${joints} joints, unit ${unit}: not a sound header`);
  return { joints, frames, stored, flags, size, values, mask };
}

function refuse(where: string, what: string): never {
  throw new FaceError(where, what);
}

function maskPlaces(bits: Uint8Array, joints: number): number[] {
  return Array.from({ length: joints }, (_, i) => i).filter((i) => bits[i >> 3] & (1 << (i & 7)));
}

function ascending(times: Float32Array, where: string): Float32Array {
  if (!times.every((time, i) => Number.isFinite(time) && (i === 0 || time > times[i - 1]))) {
    refuse(where, "times don't ascend, expected different seconds in order");
  }
  return times;
}

/** The hash by which a payload names joints, of their paths in order. */
export async function jointsHash(paths: string[]): Promise<string> {
  const hash = await shortHash(new TextEncoder().encode(paths.join("\n")));
  if (hash === null) throw new FaceError("browser", "has no SHA-256 here, expected a page from https or localhost");
  return hash;
}

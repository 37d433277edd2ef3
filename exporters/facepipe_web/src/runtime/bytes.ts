/** Numbers and sections of facepipe's binary files (docs/files.md), every count checked before it is used. */
import { FaceError } from "./errors";

export interface Section {
  kind: number;
  data: Uint8Array;
  /** a reader that does not know it refuses the file */
  required: boolean;
}

const MOST_SECTIONS = 64;
const LONGEST = 5; // bytes of a length

/** Takes bytes one after another. */
export class Bytes {
  private at = 0;
  private readonly view: DataView;

  /** @param where for messages */
  constructor(
    readonly data: Uint8Array,
    private readonly where: string,
  ) {
    this.view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  }

  get left(): number {
    return this.data.length - this.at;
  }

  /** @throws FaceError fewer bytes are there */
  take(count: number): Uint8Array {
    return this.data.subarray(this.skip(count), this.at);
  }

  byte = (): number => this.view.getUint8(this.skip(1));
  uint16 = (): number => this.view.getUint16(this.skip(2), true);
  uint32 = (): number => this.view.getUint32(this.skip(4), true);
  float16 = (): number => half(this.uint16());
  float32 = (): number => this.view.getFloat32(this.skip(4), true);

  /** So many numbers. */
  many(count: number, size: number, read: () => number): number[] {
    if (count * size > this.left) this.skip(count * size);
    return Array.from({ length: count }, read);
  }

  /** Whole numbers in four planes of bytes, the low ones first, folded to 0, -1, 1, -2, ... */
  planes(count: number): Int32Array {
    const own = this.take(4 * count);
    const found = new Int32Array(count);
    for (let i = 0; i < count; i++) {
      const folded = own[i] | (own[count + i] << 8) | (own[2 * count + i] << 16) | (own[3 * count + i] << 24);
      found[i] = (folded >>> 1) ^ -(folded & 1);
    }
    return found;
  }

  /** UTF-8 after a byte that counts it. */
  name = (): string => this.text(this.byte());

  text(count: number): string {
    try {
      return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(this.take(count));
    } catch (error) {
      throw error instanceof FaceError ? error : this.wrong("a name that is no UTF-8");
    }
  }

  end(): void {
    if (this.left) throw this.wrong(`${this.data.length} bytes, expected ${this.at}`);
  }

  wrong(what: string): FaceError {
    return new FaceError(this.where, what);
  }

  private skip(count: number): number {
    if (count > this.left) throw this.wrong(`${this.data.length} bytes, expected ${count} after ${this.at}`);
    this.at += count;
    return this.at - count;
  }
}

/**
 * The sections that bytes are, by kind.
 * @throws FaceError too many, longer than what is there, or kinds that don't ascend
 */
export function readSections(data: Uint8Array, where: string): Map<number, Section> {
  const found = new Map<number, Section>();
  let last = 0;
  for (let at = 0; at < data.length; ) {
    const trail = `${where} -> section ${found.size + 1}`;
    const kind = data[at] & 0x7f;
    if (found.size === MOST_SECTIONS) throw new FaceError(where, `more than ${MOST_SECTIONS} sections`);
    if (kind <= last) throw new FaceError(trail, `kind ${kind}, expected each once, ascending from 1`);
    const { length, start } = readLength(data, at + 1, trail);
    const left = data.length - start;
    if (length > left) throw new FaceError(trail, `${length} bytes, expected at most the ${left} that follow`);
    found.set(kind, { kind, data: data.subarray(start, start + length), required: data[at] > 0x7f });
    [last, at] = [kind, start + length];
  }
  return found;
}

/** The length at a place, in groups of 7 bits, and the place after it. */
function readLength(data: Uint8Array, at: number, where: string): { length: number; start: number } {
  let length = 0;
  for (let i = 0; i < LONGEST && at + i < data.length; i++) {
    const byte = data[at + i];
    length += (byte & 0x7f) * 2 ** (7 * i);
    if (byte > 0x7f) continue;
    if (i && !byte) break;
    return { length, start: at + i + 1 };
  }
  throw new FaceError(where, `a length without end or with needless bytes, expected at most ${LONGEST} bytes`);
}

/** A half-precision number. */
export function half(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

/** That of zlib and PNG. */
export function crc32(bytes: Uint8Array): number {
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}

/** The first 8 bytes of a SHA-256, hexadecimal; null where the page is from neither https nor localhost. */
export async function shortHash(bytes: Uint8Array<ArrayBuffer>): Promise<string | null> {
  const digest = await globalThis.crypto?.subtle?.digest("SHA-256", bytes);
  return digest ? hex(new Uint8Array(digest, 0, 8)) : null;
}

export function hex(bytes: Uint8Array): string {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

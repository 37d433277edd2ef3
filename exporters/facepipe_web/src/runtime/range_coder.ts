/** Bits from bytes by how likely each is: the range coder of docs/files.md, "A person (.fpb)". */
import { FaceError } from "./errors";

const ONE = 1 << 16; // the probability 1
const SLOWEST = 5; // shift of a context that has seen bits enough
const TOP = 1 << 24;
const MARGIN = 4; // zeros that a writer may leave out
const LARGEST = 15; // bits of a number
const LONG = 14; // of a size, which is counted one by one up to here
export const KINDS_OF_SIZES = 6; // contexts of a size

export class BitReader {
  private readonly likely: Int32Array;
  private readonly shifts: Uint8Array;
  private at = 0;
  private span = 2 ** 32 - 1;
  private code = 0;

  /** @param count contexts */
  constructor(
    private readonly data: Uint8Array,
    count: number,
    private readonly where: string,
  ) {
    this.likely = new Int32Array(count).fill(ONE / 2);
    this.shifts = new Uint8Array(count).fill(1);
    for (let i = 0; i < MARGIN; i++) this.code = this.code * 256 + this.next();
  }

  /** The next bit, of a context. */
  bit(context: number): number {
    const { likely, shifts } = this;
    const bound = (this.span >>> 12) * Math.max(likely[context] >> 4, 1);
    const bit = this.code < bound ? 0 : 1;
    if (bit) {
      this.code -= bound;
      this.span -= bound;
      likely[context] -= likely[context] >> shifts[context];
    } else {
      this.span = bound;
      likely[context] += (ONE - 1 - likely[context]) >> shifts[context];
    }
    if (shifts[context] < SLOWEST) shifts[context]++;
    this.fill();
    return bit;
  }

  /** The next number of some bits, all values alike. */
  number(bits: number): number {
    let value = 0;
    for (let i = 0; i < bits; i++) {
      this.span = this.span >>> 1;
      const bit = this.code < this.span ? 0 : 1;
      if (bit) this.code -= this.span;
      value = 2 * value + bit;
      this.fill();
    }
    return value;
  }

  /**
   * The next number of 0 or more (Exp-Golomb).
   * @throws FaceError it has more than 15 bits
   */
  growing(): number {
    let length = 0;
    while (this.number(1)) {
      if (++length > LARGEST) throw new FaceError(this.where, `a number of more than ${LARGEST} bits, expected small ones`);
    }
    return (1 << length) - 1 + this.number(length);
  }

  /** The next number of 1 or more, in KINDS_OF_SIZES contexts, each a stride from the one before. */
  size(context: number, stride: number): number {
    let size = 1;
    while (size < LONG && this.bit(context + (Math.min(size, KINDS_OF_SIZES) - 1) * stride)) size++;
    return size === LONG ? size + this.growing() : size;
  }

  private fill(): void {
    while (this.span < TOP) {
      this.span *= 256;
      this.code = this.code * 256 + this.next();
    }
  }

  private next(): number {
    if (this.at === this.data.length + MARGIN) throw new FaceError(this.where, "ends in the middle, expected more bytes");
    return this.data[this.at++] ?? 0;
  }
}

/** Offsets of points by levels, each point's predicted from coarser ones: docs/files.md, "A person (.fpb)", Levels. */
import type { Basis, Level } from "./basis";
import { Bytes } from "./bytes";
import { BitReader, KINDS_OF_SIZES } from "./range_coder";

const WHOLE = 64; // shares are so many-th
const FINER = 1.15; // times finer steps at each coarser level
const MOST_OFFSET = 1e4; // millimetres
const NEAR = 4; // neighbours whose steps tell how many a point has
const AROUND = 4;
const AXES = 1 + AROUND;
const STEPS = AXES + 3 * 2 * AROUND;
const CONTEXTS = STEPS + KINDS_OF_SIZES * AROUND;

/**
 * Add the offsets of a section to points.
 * @param points 3 numbers each, millimetres
 * @throws FaceError bytes that are cut, that don't fit the basis, or numbers beyond limits
 */
export function addOffsets(basis: Basis, data: Uint8Array, points: Float64Array, where: string): void {
  const bytes = new Bytes(data, where);
  const step = bytes.float32();
  const sent = bytes.byte();
  if (!(step > 0 && step <= MOST_OFFSET)) throw bytes.wrong(`steps of ${step} mm, expected more than 0 and at most ${MOST_OFFSET}`);
  if (sent >= basis.levels.length) throw bytes.wrong(`${sent} levels, expected at most the ${basis.levels.length - 1} of its basis`);
  const reader = new BitReader(bytes.take(bytes.left), CONTEXTS, where);
  const [got, steps] = [new Float64Array(points.length), new Int32Array(points.length)];
  basis.levels.forEach((level, number) => {
    if (number <= sent) readSteps(reader, level, steps);
    const size = number <= sent ? step * FINER ** (number - sent) : 0;
    const { rows, neighbours, shares, width } = level;
    for (let i = 0; i < rows.length; i++) {
      for (let axis = 0; axis < 3; axis++) {
        let sum = 0;
        for (let k = i * width; k < (i + 1) * width; k++) sum += shares[k] * got[3 * neighbours[k] + axis];
        got[3 * rows[i] + axis] = sum / WHOLE + size * steps[3 * rows[i] + axis];
      }
    }
  });
  for (let i = 0; i < got.length; i++) {
    if (!(Math.abs(got[i]) <= MOST_OFFSET)) throw bytes.wrong(`offsets above ${MOST_OFFSET} mm, expected smaller ones`);
    points[i] += got[i];
  }
}

/** How much is going on around a point: 3 where its neighbours are many steps from what predicted them. */
function around({ neighbours, width }: Level, i: number, steps: Int32Array): number {
  if (!width) return AROUND - 1;
  let total = 0;
  for (let k = i * width; k < i * width + Math.min(NEAR, width); k++) {
    const at = 3 * neighbours[k];
    total += Math.abs(steps[at]) + Math.abs(steps[at + 1]) + Math.abs(steps[at + 2]);
  }
  return total < 3 ? Math.min(total, 2) : total < 4 ? 2 : 3;
}

/** Read the steps of a level's points. */
function readSteps(reader: BitReader, level: Level, steps: Int32Array): void {
  if (!reader.bit(0)) return;
  level.rows.forEach((row, i) => {
    const near = around(level, i, steps);
    if (!reader.bit(1 + near)) return;
    let before = 0;
    for (let axis = 0; axis < 3; axis++) {
      // the last one moves if none before it did
      if ((axis < 2 || before) && !reader.bit(AXES + (2 * axis + before) * AROUND + near)) continue;
      before = 1;
      const negative = reader.number(1);
      const size = reader.size(STEPS + near, AROUND);
      steps[3 * row + axis] = negative ? -size : size;
    }
  });
}

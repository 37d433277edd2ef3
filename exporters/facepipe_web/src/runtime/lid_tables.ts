/** What blinks, looks and squints of persons are fitted by: docs/files.md, "Lids". */
import type { Bytes } from "./bytes";

/** An eye; the right one is the mirror image of itself. */
export interface LidEye {
  /** points of lids */
  lids: number[];
  /** points of the eyeball: the first, and the one after the last */
  ball: [number, number];
  /** numbers of the joints that carry the upper lid and the lower */
  joints: [number, number];
  /** of these for each point of lids: all of the upper, all of the lower */
  shares: Float64Array;
  /** of the mean's eyeball, millimetres */
  centre: number[];
  /** of each slider: how far the eyeball goes, and what is added to its scale */
  balls: number[];
  /** of each slider: how far the lids' joints go up, and what is added to their scale along y */
  stretches: number[];
  /** of each slider x y z of each point of lids, millimetres */
  ends: Float64Array;
  /** the same of WAYS shapes */
  ways: Float64Array;
  /** of the eyeball's outside in bands of y, by x: direction from the centre, millimetres */
  outside: Float64Array[];
}

export interface LidTables {
  /** of each point of lids, from behind the margin out */
  rings: Uint8Array;
  /** 1 above */
  upper: Uint8Array;
  /** rows of the inner and the outer corner */
  corners: [number, number];
  /** how many points are beside each */
  links: Uint8Array;
  /** those that are of lids */
  beside: number[][];
  cells: number;
  /** `cells` x `cells` millimetres that the eyeball reaches */
  reach: Float64Array;
  sliders: number;
  eyes: [LidEye, LidEye];
}

export const RINGS = 13;
export const MARGIN = 4; // the last ring of it
export const BANDS = 16; // of directions, by their y from -1 to 1
const WAYS = 7;
const MOST_CELLS = 1024;
const NEAREST = 3; // points that say how far an eyeball reaches
const FARTHEST = 1e5; // millimetres
const GRID = 100; // places in a millimetre
const REACH_GRID = 1e4;
const FULL = 65535;

/**
 * @param mean all x, all y, all z of the basis
 * @param joints how many the basis has
 */
export function readLids(bytes: Bytes, mean: Float64Array, joints: number): LidTables {
  const [count, sliders, cells] = [bytes.uint16(), bytes.byte(), bytes.uint16()];
  const corners: [number, number] = [bytes.uint16(), bytes.uint16()];
  const [rings, upper, links, inside] = [0, 1, 2, 3].map(() => bytes.take(count));
  const sides = new Set(rings.map((ring, i) => 2 * ring + upper[i]));
  const whole = Array.from({ length: 2 * (MARGIN + 1) }, (_, side) => sides.has(side)).every(Boolean);
  if (!whole || !rings.every((ring) => ring < RINGS) || !upper.every((one) => one < 2)) {
    throw bytes.wrong(`rings of lids up to ${RINGS - 1}, of which 0 to ${MARGIN} have points above and below`);
  }
  const apart = corners[0] !== corners[1] && corners.every((corner) => corner < count);
  if (!apart || !links.every((all, i) => all && inside[i] <= all)) throw bytes.wrong("corners that are not there, or points of lids that nothing is beside");
  const beside = Array.from(inside, (some) => bytes.many(some, 2, bytes.uint16));
  if (!beside.flat().every((row) => row < count)) throw bytes.wrong(`points beside others that are not there, expected rows below ${count}`);
  if (!sliders || cells < 2 || cells > MOST_CELLS) throw bytes.wrong(`${sliders} sliders, ${cells} cells, expected 2 to ${MOST_CELLS} cells`);
  const reach = sums(bytes, cells * cells, 1, REACH_GRID);
  const [left, right] = [1, -1].map((mirror) => readEye(bytes, count, sliders, mean, joints, mirror));
  bytes.end();
  return { rings, upper, corners, links, beside, cells, reach, sliders, eyes: [left, right] };
}

function readEye(bytes: Bytes, count: number, sliders: number, mean: Float64Array, joints: number, mirror: number): LidEye {
  const points = mean.length / 3;
  const ball: [number, number] = [bytes.uint32(), bytes.uint32()];
  const own: [number, number] = [bytes.uint16(), bytes.uint16()];
  const size = bytes.uint16();
  const [lids, shell] = [count, size].map((some) => bytes.many(some, 4, bytes.uint32));
  if (size < NEAREST) throw bytes.wrong(`${size} points of an eyeball's outside, expected ${NEAREST} at least`);
  const there = ball[0] < ball[1] && ball[1] <= points && [...lids, ...shell].every((row) => row < points);
  if (!there || Math.max(...own) >= joints) throw bytes.wrong("points or joints of an eye that are not there");
  const shares = Float64Array.from(bytes.many(2 * count, 2, bytes.uint16), (share) => share / FULL);
  const [centre, balls, stretches] = [3, 4 * sliders, 2 * sliders].map((some) => bytes.many(some, 4, bytes.float32));
  if (![...centre, ...balls, ...stretches].every((one) => Math.abs(one) <= FARTHEST)) throw bytes.wrong(`an eye farther than ${FARTHEST} mm`);
  const [ends, ways] = [sliders, WAYS].map((times) => interleaved(sums(bytes, count, 3 * times, GRID), count));
  const outside = shell.map((row) => {
    const way = [0, 1, 2].map((axis) => (axis ? 1 : mirror) * mean[axis * points + row] - centre[axis]);
    const length = Math.max(Math.hypot(...way), 1e-9);
    return [...way.map((one) => one / length), length];
  });
  outside.sort((a, b) => a[0] - b[0]);
  const bands = Array.from({ length: BANDS }, (_, band) => Float64Array.from(outside.filter((way) => bandOf(way[1]) === band).flat()));
  return { lids, ball, joints: own, shares, centre, balls, stretches, ends, ways, outside: bands };
}

/** The band of a direction with that y. */
export function bandOf(y: number): number {
  return y > -1 ? Math.min(((y + 1) * (BANDS / 2)) | 0, BANDS - 1) : 0;
}

/** Sums of `count` numbers one after another, `times` times, in millimetres. */
function sums(bytes: Bytes, count: number, times: number, grid: number): Float64Array {
  const found = Float64Array.from(bytes.planes(count * times));
  for (let i = 0; i < found.length; i++) if (i % count) found[i] += found[i - 1];
  const inside = found.every((place) => Math.abs(place) <= grid * FARTHEST);
  if (!inside) throw bytes.wrong(`lids or eyeballs farther than ${FARTHEST} mm`);
  return found.map((place) => place / grid);
}

/** All x, y, z, again and again, as x y z of each. */
function interleaved(planes: Float64Array, count: number): Float64Array {
  const found = new Float64Array(planes.length);
  planes.forEach((value, i) => {
    const [plane, row] = [Math.floor(i / count), i % count];
    found[3 * (Math.floor(plane / 3) * count + row) + (plane % 3)] = value;
  });
  return found;
}

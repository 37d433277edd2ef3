/** Joints that are who somebody is, which pose nothing: docs/files.md, "A person (.fpb)", Identity joints. */
import type { Bytes } from "./bytes";
import { motionOf } from "./motion";
import { BitReader, KINDS_OF_SIZES } from "./range_coder";

/** Those of a basis, and their weights of points one after another. */
export interface IdentityJoints {
  /** the point that has the first weights */
  first: number;
  /** x y z of each, millimetres */
  places: Float32Array;
  /** joints of a point */
  width: number;
  /** `width` for each point */
  joints: Uint8Array;
  /** of them, 255ths */
  weights: Uint8Array;
}

/** Nine numbers of each of the first identity joints of a basis, in steps. */
export interface JointSteps {
  /** millimetres */
  step: number;
  numbers: Int32Array;
}

const FARTHEST = 1e5; // millimetres
const FULL = 255; // weights of a point, in sum
const LARGEST_STEP = 10; // millimetres
const LARGEST_STEPS = 127;
const LEVER = 16; // millimetres: a radian or a factor counts as that far
const CHANNELS = 9;
const EACH = 1 + KINDS_OF_SIZES; // contexts of three channels

/** @param points of the basis */
export function readIdentityJoints(bytes: Bytes, points: number): IdentityJoints {
  const [count, width, first, rows] = [bytes.byte(), bytes.byte(), bytes.uint32(), bytes.uint32()];
  if (!count || !width || !rows || first + rows > points) {
    throw bytes.wrong(`${count} joints, ${width} a point, points ${first} to ${first + rows}, of ${points}`);
  }
  const places = Float32Array.from(bytes.many(3 * count, 4, bytes.float32));
  const [joints, weights] = [0, 1].map(() => byPoint(bytes.take(width * rows), width));
  bytes.end();
  if (!places.every((place) => Math.abs(place) <= FARTHEST) || !joints.every((joint) => joint < count)) {
    throw bytes.wrong(`places or joints of points that are not there, expected joints below ${count}`);
  }
  for (let at = 0; at < weights.length; at += width) {
    let sum = 0;
    for (let k = at; k < at + width; k++) sum += weights[k];
    if (sum !== FULL) throw bytes.wrong(`weights of a point whose sum is ${sum}, expected ${FULL}`);
  }
  return { first, places, width, joints, weights };
}

/** Bytes of all points' first ones, then all second ones ... as those of point after point. */
function byPoint(bytes: Uint8Array, width: number): Uint8Array {
  const [found, rows] = [new Uint8Array(bytes.length), bytes.length / width];
  for (let k = 0, at = 0; k < width; k++) for (let i = 0; i < rows; i++, at++) found[i * width + k] = bytes[at];
  return found;
}

/**
 * The section of a person.
 * @throws FaceError bytes that are cut, or numbers beyond limits
 */
export function readJointSteps(bytes: Bytes, where: string): JointSteps {
  const [step, count] = [bytes.float16(), bytes.byte()];
  if (!(step > 0 && step <= LARGEST_STEP) || !count) {
    throw bytes.wrong(`${count} joints in steps of ${step} mm, expected some in steps above 0, at most ${LARGEST_STEP}`);
  }
  return { step, numbers: readJointNumbers(bytes, count, CHANNELS, where) };
}

/**
 * Whole numbers of joints, the rest of the bytes.
 * @param channels of a joint, three of each kind
 * @throws FaceError bytes that are cut, or numbers beyond limits
 */
export function readJointNumbers(bytes: Bytes, joints: number, channels: number, where: string): Int32Array {
  const reader = new BitReader(bytes.take(bytes.left), 3 * EACH, where);
  const numbers = new Int32Array(channels * joints);
  for (let i = 0; i < numbers.length; i++) {
    const context = (((i % channels) / 3) | 0) * EACH;
    if (!reader.bit(context)) continue;
    const negative = reader.number(1);
    const size = reader.size(context + 1, 1);
    if (size > LARGEST_STEPS) throw bytes.wrong(`${size} steps of joint ${(i / channels) | 0}, expected at most ${LARGEST_STEPS}`);
    numbers[i] = negative ? -size : size;
  }
  return numbers;
}

/**
 * Add what joints make of the mean face: `p <- p + sum_j w_j (M_j - 1) (r - c_j)`.
 * @param mean 3 numbers a point, as `points`
 */
export function addIdentityJoints(own: IdentityJoints, { step, numbers }: JointSteps, mean: Float64Array, points: Float64Array): void {
  const ways = new Float64Array(4 * own.places.length); // of zeros: at rest
  for (let at = 0, joint = 0; at < numbers.length; at += CHANNELS, joint++) {
    const coefficients = Array.from({ length: CHANNELS }, (_, k) => (k > 5 ? 1 : 0) + (step * numbers[at + k]) / (k < 3 ? 1 : LEVER));
    const way = motionOf(coefficients);
    for (let row = 0; row < 3; row++) {
      way[5 * row] -= 1;
      for (let k = 0; k < 3; k++) way[4 * row + 3] -= way[4 * row + k] * own.places[3 * joint + k];
    }
    ways.set(way.map((number) => number / FULL), 12 * joint);
  }
  const { joints, weights, width } = own;
  for (let at = 0, place = 3 * own.first; at < joints.length; place += 3) {
    const [x, y, z] = [mean[place], mean[place + 1], mean[place + 2]];
    for (const end = at + width; at < end; at++) {
      const [way, weight] = [12 * joints[at], weights[at]];
      points[place] += weight * (ways[way] * x + ways[way + 1] * y + ways[way + 2] * z + ways[way + 3]);
      points[place + 1] += weight * (ways[way + 4] * x + ways[way + 5] * y + ways[way + 6] * z + ways[way + 7]);
      points[place + 2] += weight * (ways[way + 8] * x + ways[way + 9] * y + ways[way + 10] * z + ways[way + 11]);
    }
  }
}

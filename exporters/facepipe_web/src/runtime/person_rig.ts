/** How a person's joints rest and shapes go, against what points alone give: docs/files.md, "A person (.fpb)", Rig. */
import type { Bytes } from "./bytes";
import { readJointNumbers } from "./identity_joints";
import { type Motion, motionOf } from "./motion";

export interface PersonRig {
  /** of offsets of shapes but those of lids: x y z of a unit quaternion, logarithm of the scale */
  shapes: number[];
  /** of each of the basis's first joints, in millimetres along the axes of the world: what takes it to its rest */
  rests: Motion[];
}

const CHANNELS = 6;
const [LARGEST_MOVE, LARGEST_TURN] = [10, 0.1]; // millimetres and radians of a step

/**
 * The section of a person; whether the shapes' numbers are sound is left to who reads placements.
 * @throws FaceError bytes that are cut, or steps beyond limits
 */
export function readRig(bytes: Bytes, where: string): PersonRig {
  const shapes = bytes.many(4, 2, bytes.float16);
  const [move, turn, count] = [bytes.float16(), bytes.float16(), bytes.byte()];
  if (!(move > 0 && move <= LARGEST_MOVE && turn > 0 && turn <= LARGEST_TURN)) {
    throw bytes.wrong(`steps of ${move} mm and ${turn} radians, expected some above 0, at most ${LARGEST_MOVE} and ${LARGEST_TURN}`);
  }
  const numbers = readJointNumbers(bytes, count, CHANNELS, where);
  const turned = [0, 0, 0];
  const rests = Array.from({ length: count }, (_, joint) => {
    const [x, y, z, ...turns] = numbers.subarray(CHANNELS * joint, CHANNELS * (joint + 1));
    turns.forEach((steps, axis) => (turned[axis] += steps)); // less the joint's before
    return motionOf([move * x, move * y, move * z, ...turned.map((steps) => turn * steps), 1, 1, 1]);
  });
  return { shapes, rests };
}

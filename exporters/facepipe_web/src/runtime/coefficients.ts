/** From bone coefficients to what joints do relative to rest. */
import type { Matrix4 } from "three";
import { motionOf } from "./motion";

/**
 * M of every joint in glTF space: axes M inverse(axes).
 * @param coefficients 9 numbers a joint
 * @param axes units and axes of the stage -> glTF, linear
 */
export function localMotions(coefficients: Float32Array, axes: Matrix4, out: Matrix4[]): Matrix4[] {
  const back = axes.clone().invert();
  out.forEach((motion, i) => {
    motion.set(...motionOf(coefficients.subarray(9 * i, 9 * i + 9)), 0, 0, 0, 1);
    motion.premultiply(axes).multiply(back);
  });
  return out;
}

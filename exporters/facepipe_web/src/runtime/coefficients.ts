/** From bone coefficients to what joints do relative to rest: M = T Rz Rx Ry S for column vectors. */
import { Euler, Matrix4 } from "three";

const euler = new Euler();
const scaling = new Matrix4();

/**
 * M of every joint in glTF space: axes M inverse(axes).
 * @param coefficients 9 numbers a joint
 * @param axes units and axes of the stage -> glTF, linear
 */
export function localMotions(coefficients: Float32Array, axes: Matrix4, out: Matrix4[]): Matrix4[] {
  const back = axes.clone().invert();
  out.forEach((motion, i) => {
    const [tx, ty, tz, rx, ry, rz, sx, sy, sz] = coefficients.subarray(9 * i, 9 * i + 9);
    motion.makeRotationFromEuler(euler.set(rx, ry, rz, "ZXY")).multiply(scaling.makeScale(sx, sy, sz));
    motion.setPosition(tx, ty, tz).premultiply(axes).multiply(back);
  });
  return out;
}

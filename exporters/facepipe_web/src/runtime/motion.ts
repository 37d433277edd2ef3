/** M = T Rz Rx Ry S of a joint's nine bone coefficients, for column vectors: three rows of four. */
export type Motion = [number, number, number, number, number, number, number, number, number, number, number, number];

/** @param coefficients tx ty tz rx ry rz sx sy sz */
export function motionOf([tx, ty, tz, rx, ry, rz, sx, sy, sz]: ArrayLike<number> & Iterable<number>): Motion {
  const [a, b, c] = [Math.sin(rx), Math.sin(ry), Math.sin(rz)];
  const [u, v, w] = [Math.cos(rx), Math.cos(ry), Math.cos(rz)];
  return [
    (w * v - c * a * b) * sx, -c * u * sy, (w * b + c * a * v) * sz, tx,
    (c * v + w * a * b) * sx, w * u * sy, (c * b - w * a * v) * sz, ty,
    -u * b * sx, a * sy, u * v * sz, tz,
  ];
}

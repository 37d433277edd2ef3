/** Points of a face read back on the CPU, as three.js morphs and skins them. */
import { type Group, Vector3 } from "three";
import { type FaceMesh, pointNumbers } from "./glb";

/** 3 numbers a point of the stage, relative to `root`: metres, Y up; points that no vertex stands for are `missing`. */
export function readPoints(root: Group, mesh: FaceMesh, missing = 0): Float32Array {
  root.updateWorldMatrix(true, true);
  const back = root.matrixWorld.clone().invert();
  const found = new Float32Array(3 * mesh.pointCount).fill(missing);
  const at = new Vector3();
  for (const primitive of mesh.primitives) {
    const numbers = pointNumbers(primitive);
    const toRoot = back.clone().multiply(primitive.matrixWorld);
    for (let vertex = 0; vertex < numbers.length; vertex++) {
      primitive.getVertexPosition(vertex, at).applyMatrix4(toRoot).toArray(found, 3 * numbers[vertex]);
    }
  }
  return found;
}

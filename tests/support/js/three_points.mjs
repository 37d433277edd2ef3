// World points of meshes as three.js deforms them: x y z of each, mesh by mesh.
import { Vector3 } from "three";

export function points(scene) {
  scene.updateMatrixWorld(true);
  const meshes = [];
  scene.traverse((object) => object.isMesh && meshes.push(object));
  return meshes.map((mesh) => {
    mesh.skeleton?.update();
    const { count } = mesh.geometry.attributes.position;
    const positions = new Float32Array(3 * count);
    const point = new Vector3();
    for (let i = 0; i < count; i++)
      mesh.getVertexPosition(i, point).applyMatrix4(mesh.matrixWorld).toArray(positions, 3 * i);
    return positions;
  });
}

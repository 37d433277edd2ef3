// World points of meshes as Babylon.js deforms them: x y z of each, mesh by mesh, right-handed.
import { Matrix, Vector3 } from "@babylonjs/core/Maths/math.vector.js";

export function points(container) {
  const toFile = Matrix.Invert(container.rootNodes[0].computeWorldMatrix(true)); // Babylon's world is left-handed
  container.transformNodes.forEach((one) => one.computeWorldMatrix(true));
  container.skeletons.forEach((one) => one.prepare(true));
  return container.meshes.filter((one) => one.getTotalVertices()).map((mesh) => {
    const positions = new Float32Array(mesh.getPositionData(true, true));
    const matrix = mesh.computeWorldMatrix(true).multiply(toFile);
    for (let i = 0; i < positions.length; i += 3)
      Vector3.TransformCoordinates(Vector3.FromArray(positions, i), matrix).toArray(positions, i);
    return positions;
  });
}

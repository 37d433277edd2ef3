/** Weights of morph targets: from a graph's activations, or from shape weights where there is no graph. */
import type { FaceMesh } from "./glb";
import type { Metadata } from "./metadata";

/** Set the targets of each mesh from the graph's activations, matched by `meshes[i].targets`. */
export function setFromGraph(meshes: FaceMesh[], metadata: Metadata, activations: Float32Array): void {
  const numbers = new Map(metadata.meshes.map((one) => [one.name, one.targets]));
  for (const mesh of meshes) {
    const own = numbers.get(mesh.name) ?? [];
    for (const { morphTargetInfluences } of mesh.primitives) {
      own.forEach((number, target) => (morphTargetInfluences![target] = activations[number]));
    }
  }
}

/** The shapes of a GLB: its targets without inbetweens, each name once. */
export function shapesOf(meshes: FaceMesh[]): string[] {
  return [...new Set(meshes.flatMap((mesh) => mesh.targets.filter((name) => !(name in mesh.inbetweens))))];
}

/** Set the targets of each mesh from shape weights, through the curves of inbetweens. */
export function setFromShapes(meshes: FaceMesh[], weights: ReadonlyMap<string, number>): void {
  for (const mesh of meshes) {
    mesh.targets.forEach((name, target) => {
      const weight = weights.get(mesh.inbetweens[name]?.shape ?? name) ?? 0;
      const value = mesh.curves[name] ? along(mesh.curves[name], weight) : weight;
      for (const { morphTargetInfluences } of mesh.primitives) morphTargetInfluences![target] = value;
    });
  }
}

/** Straight lines between knots, the first and the last of them extended. */
export function along(knots: [number, number][], at: number): number {
  let next = knots.findIndex(([weight]) => weight >= at);
  next = next < 0 ? knots.length - 1 : Math.max(next, 1);
  const [[x0, y0], [x1, y1]] = [knots[next - 1], knots[next]];
  return y0 + ((at - x0) / (x1 - x0)) * (y1 - y0);
}

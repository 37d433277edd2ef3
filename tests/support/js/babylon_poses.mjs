// Poses GLBs in Babylon.js. usage: node babylon_poses.mjs < request; request and answer as poses.mjs has them
import { NullEngine } from "@babylonjs/core/Engines/nullEngine.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { MeshoptCompression } from "@babylonjs/core/Meshes/Compression/meshoptCompression.js";
import { Logger } from "@babylonjs/core/Misc/logger.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/2.0/index.js";
import { MeshoptDecoder } from "meshoptimizer/decoder";
import { points } from "./babylon_points.mjs";
import { answer, bytesOf } from "./poses.mjs";

Logger.LogLevels = Logger.ErrorLogLevel; // stdout is the answer's
await MeshoptDecoder.ready;
MeshoptCompression._Default = { // its own comes by a script element
  async decodeGltfBufferAsync(source, count, stride, mode, filter) {
    const result = new Uint8Array(count * stride);
    MeshoptDecoder.decodeGltfBuffer(result, count, stride, source, mode, filter);
    return result;
  },
};
const scene = new Scene(new NullEngine());
await answer(async (path) => {
  const container = await LoadAssetContainerAsync(new Uint8Array(bytesOf(path)), scene, { pluginExtension: ".glb" });
  container.addAllToScene();
  const meshes = container.meshes.filter((one) => one.getTotalVertices());
  const bones = Object.fromEntries(container.skeletons.flatMap((one) => one.bones).map((one) => [one.name, one]));
  return {
    points: meshes.map(() => null), // unknown attributes are not kept
    pose({ weights, joints }) {
      for (const [name, trs] of Object.entries(joints)) {
        const node = bones[name].getTransformNode();
        node.position.fromArray(trs);
        node.rotationQuaternion.fromArray(trs, 3);
        node.scaling.fromArray(trs, 7);
      }
      meshes.forEach((mesh) => {
        for (const [name, weight] of Object.entries(weights[nameOf(mesh)]))
          mesh.morphTargetManager.getTargetByName(name).influence = weight;
      });
      return points(container);
    },
  };
});

/** The name of a glTF mesh: several primitives are children of a node of that name. */
function nameOf(mesh) {
  return mesh.parent.name === "__root__" ? mesh.name : mesh.parent.name;
}

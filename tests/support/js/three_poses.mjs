// Poses GLBs in three.js. usage: node three_poses.mjs < request; request and answer as poses.mjs has them
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { answer, bytesOf } from "./poses.mjs";
import { points } from "./three_points.mjs";

// node decodes no images; geometry and motion, which this program is for, need none
globalThis.self = globalThis;
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });

await answer(async (path) => {
  const { scene } = await new GLTFLoader().parseAsync(bytesOf(path), "");
  const meshes = [];
  scene.traverse((object) => object.isMesh && meshes.push(object));
  return {
    points: meshes.map((mesh) => Array.from(mesh.geometry.attributes._facepipe_point.array)),
    pose({ weights, joints }) {
      for (const [name, trs] of Object.entries(joints)) {
        const bone = scene.getObjectByName(name);
        bone.position.fromArray(trs);
        bone.quaternion.fromArray(trs, 3);
        bone.scale.fromArray(trs, 7);
      }
      meshes.forEach((mesh) => {
        for (const [name, weight] of Object.entries(weights[nameOf(mesh)]))
          mesh.morphTargetInfluences[mesh.morphTargetDictionary[name]] = weight;
      });
      return points(scene);
    },
  };
});

/** The name of a glTF mesh: several primitives are children of a group of that name. */
function nameOf(mesh) {
  return mesh.parent.isGroup && mesh.parent.parent ? mesh.parent.name : mesh.name;
}

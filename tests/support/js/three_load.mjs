// Loads a GLB with three.js and prints what it sees, as JSON.
// usage: node three_load.mjs FILE < request
// request: {"weights": {target name: weight}, "joints": {joint name: 16 numbers, local matrix, column-major}}
// answer:  {"joints": count, "meshes": [{"name", "targets": [...], "points": [...], "positions": [[x, y, z], ...]}]}
//          one entry per primitive; positions are in the world, deformed
import { readFileSync } from "node:fs";
import { Vector3 } from "three";
import { MeshoptDecoder } from "three/examples/jsm/libs/meshopt_decoder.module.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

// node decodes no images; geometry and motion, which this program is for, need none
globalThis.self = globalThis;
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });

const [path] = process.argv.slice(2);
const request = JSON.parse(readFileSync(0, "utf8"));
const bytes = readFileSync(path);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).parseAsync(buffer, "");

const joints = new Set();
gltf.scene.traverse((object) => {
  const matrix = object.isBone ? request.joints[object.name] : undefined;
  if (matrix) {
    object.matrixAutoUpdate = false;
    object.matrix.fromArray(matrix);
  }
  object.skeleton?.bones.forEach((bone) => joints.add(bone));
});
gltf.scene.updateMatrixWorld(true);

const meshes = [];
gltf.scene.traverse((object) => {
  if (!object.isMesh) return;
  object.skeleton?.update();
  const targets = Object.keys(object.morphTargetDictionary ?? {});
  targets.forEach((name) => (object.morphTargetInfluences[object.morphTargetDictionary[name]] = request.weights[name] ?? 0));
  const { _facepipe_point: numbers, position } = object.geometry.attributes;
  const points = numbers ? Array.from(numbers.array) : [...Array(position.count).keys()]; // else vertices as they are
  const positions = points.map((_, i) => object.getVertexPosition(i, new Vector3()).applyMatrix4(object.matrixWorld).toArray());
  meshes.push({ name: object.name, targets, points, positions });
});
console.log(JSON.stringify({ joints: joints.size, meshes }));

// Loads a .vrm with three-vrm, poses it and prints what it sees, as JSON.
// usage: node vrm_load.mjs FILE < request
// request: [{"expressions": {name: value}, "bones": {human bone: [x, y, z, w]}, "lookAt": [x, y, z]}, ...], all optional;
//          bones are rotations of normalized human bones, lookAt a point of the world
// answer:  {"meta", "bones": {human bone: [x, y, z] at rest}, "expressions": [names], "lookAt": {type, offset},
//           "poses": [{"meshes": [{"name", "points": [...], "positions": [[x, y, z], ...]}],
//                      "eyes": {"leftEye": [x, y, z, w], ...}}]}
//          one entry per primitive; positions are in the world, deformed; eyes are the rotations of eye bones there
import { readFileSync } from "node:fs";
import { Quaternion, Vector3 } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { VRMLoaderPlugin } from "@pixiv/three-vrm";

// node decodes no images; geometry and motion, which this program is for, need none
globalThis.self = globalThis;
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });
for (const name of ["warn", "error"]) console[name] = (...words) => { throw new Error(words.join(" ")); };

const [path] = process.argv.slice(2);
const requests = JSON.parse(readFileSync(0, "utf8"));
const bytes = readFileSync(path);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
const { vrm } = (await loader.parseAsync(buffer, "")).userData;
const { humanoid, expressionManager, lookAt } = vrm;
vrm.scene.updateMatrixWorld(true);

const place = (bone) => humanoid.getRawBoneNode(bone).getWorldPosition(new Vector3()).toArray();
const turn = (bone) => humanoid.getRawBoneNode(bone).getWorldQuaternion(new Quaternion()).toArray();
const bones = Object.fromEntries(Object.keys(humanoid.humanBones).map((bone) => [bone, place(bone)]));
const eyeBones = ["leftEye", "rightEye"].filter((bone) => bone in bones);

function pose({ expressions = {}, bones: turns = {}, lookAt: at }) {
  humanoid.resetNormalizedPose();
  expressionManager.resetValues();
  lookAt?.reset();
  vrm.update(0); // a lookAt by expressions sets these
  for (const [name, value] of Object.entries(expressions)) {
    if (!expressionManager.getExpression(name)) throw new Error(`no expression ${name}`);
    expressionManager.setValue(name, value);
  }
  for (const [bone, turned] of Object.entries(turns)) humanoid.getNormalizedBoneNode(bone).quaternion.fromArray(turned);
  if (at) {
    humanoid.update();
    vrm.scene.updateMatrixWorld(true);
    lookAt.lookAt(new Vector3(...at));
  }
  vrm.update(0);
  vrm.scene.updateMatrixWorld(true);
  const meshes = [];
  vrm.scene.traverse((object) => {
    if (!object.isMesh) return;
    object.skeleton?.update();
    const points = Array.from(object.geometry.attributes._facepipe_point.array);
    const positions = points.map((_, i) => object.getVertexPosition(i, new Vector3()).applyMatrix4(object.matrixWorld).toArray());
    meshes.push({ name: object.name, points, positions });
  });
  return { meshes, eyes: Object.fromEntries(eyeBones.map((bone) => [bone, turn(bone)])) };
}

console.log(JSON.stringify({
  meta: vrm.meta,
  bones,
  expressions: expressionManager.expressions.map((one) => one.expressionName),
  lookAt: lookAt ? { type: lookAt.applier.constructor.type, offset: lookAt.offsetFromHeadBone.toArray() } : null,
  poses: requests.map(pose),
}));

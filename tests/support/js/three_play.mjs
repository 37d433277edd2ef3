// Plays an animation of a GLB in three.js and writes what it shows, vertex by vertex.
// usage: node three_play.mjs FILE OUT < request
// request: {"clip": name, "times": [seconds, ...]}
// OUT:     float32, the deformed world positions x y z of all vertices, time after time
// answer:  {"duration": seconds, "meshes": [{"name", "points": [...]}]}, one entry per primitive
import { closeSync, openSync, readFileSync, writeSync } from "node:fs";
import { AnimationMixer, LoopOnce, Vector3 } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

// node decodes no images; geometry and motion, which this program is for, need none
globalThis.self = globalThis;
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });

const [path, out] = process.argv.slice(2);
const request = JSON.parse(readFileSync(0, "utf8"));
const bytes = readFileSync(path);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, "");
const clip = gltf.animations.find((one) => one.name === request.clip);
const mixer = new AnimationMixer(gltf.scene);
const action = mixer.clipAction(clip).setLoop(LoopOnce);
action.clampWhenFinished = true;
action.play();

const meshes = [];
gltf.scene.traverse((object) => object.isMesh && meshes.push(object));
const counts = meshes.map((mesh) => mesh.geometry.attributes.position.count);
const rows = new Float32Array(3 * counts.reduce((sum, count) => sum + count, 0));
const file = openSync(out, "w");
const point = new Vector3();
for (const time of request.times) {
  mixer.setTime(Math.fround(time)); // as keys are
  gltf.scene.updateMatrixWorld(true);
  let at = 0;
  meshes.forEach((mesh, number) => {
    mesh.skeleton?.update();
    for (let i = 0; i < counts[number]; i++, at += 3) {
      mesh.getVertexPosition(i, point).applyMatrix4(mesh.matrixWorld).toArray(rows, at);
    }
  });
  writeSync(file, new Uint8Array(rows.buffer));
}
closeSync(file);
const named = meshes.map((mesh) => ({ name: mesh.name, points: Array.from(mesh.geometry.attributes._facepipe_point.array) }));
console.log(JSON.stringify({ duration: clip.duration, meshes: named }));

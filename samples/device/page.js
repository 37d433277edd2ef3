// A person over the standard head: head.glb and head.fpbasis are everyone's, me.fpb alone is of the person.
import { loadFace, parsePerson, readBasis } from "facepipe-web";
import { AmbientLight, Color, DirectionalLight, NeutralToneMapping, PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const canvas = document.querySelector("canvas");
const [said, person, head, file, smile] = ["said", "person", "head", "file", "smile"].map((id) => document.getElementById(id));
const renderer = new WebGLRenderer({ canvas, antialias: true });
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
renderer.toneMapping = NeutralToneMapping;
const scene = new Scene();
scene.background = new Color(0x23272e);
const camera = new PerspectiveCamera(24, 1, 0.01, 20);
camera.position.set(0.12, 0.02, 1.05);
const lamp = new DirectionalLight(0xfff1e2, 2.6);
lamp.position.set(-0.6, 0.7, 1.2);
scene.add(new AmbientLight(0xdfe8f5, 1.2), lamp);
const controls = new OrbitControls(camera, canvas);
controls.addEventListener("change", () => requestAnimationFrame(draw));

const bytes = async (url) => (await fetch(url)).arrayBuffer();
const [face, basis, own] = await Promise.all([loadFace("head.glb"), bytes("head.fpbasis").then(readBasis), bytes("me.fpb")]);
scene.add(face.root);
let payload = own;
await be(payload);
person.addEventListener("click", () => be(payload));
head.addEventListener("click", () => be(null));
file.addEventListener("change", async () => be(await file.files[0].arrayBuffer()));
smile.addEventListener("input", async () => {
  const weight = Number(smile.value);
  await face.setShapes({ mouthSmileLeft: weight, mouthSmileRight: weight, cheekSquintLeft: 0.4 * weight, cheekSquintRight: 0.4 * weight });
  draw();
});
new ResizeObserver(draw).observe(canvas);
performance.mark("shown");
document.body.dataset.state = "ready";
Object.assign(window, { face, basis, be }); // for the console

/** Be the person of a payload, or the standard head. */
async function be(bytes) {
  try {
    const start = performance.now();
    if (bytes) await face.setPerson(parsePerson(bytes, "me.fpb"), basis);
    else await face.setPerson(null);
    const took = Math.round(performance.now() - start);
    said.textContent = bytes ? `A person in ${bytes.byteLength} bytes, put on in ${took} ms` : "The standard head";
    payload = bytes ?? payload;
    person.setAttribute("aria-pressed", Boolean(bytes));
    head.setAttribute("aria-pressed", !bytes);
    draw();
  } catch (error) {
    said.textContent = error.message; // one line: what is wrong with the file
  }
}

function draw() {
  const { clientWidth: width, clientHeight: height } = canvas;
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  renderer.render(scene, camera);
}

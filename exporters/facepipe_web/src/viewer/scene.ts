/** The picture: camera, light, one face or two of them, drawn when something has changed. */
import {
  Box3, type BufferAttribute, Color, DirectionalLight, HemisphereLight, NeutralToneMapping, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { ViewedFace } from "./viewed_face";

export type Compare = "off" | "split" | "toggle";

export class Picture {
  readonly canvas: HTMLCanvasElement;
  readonly camera = new PerspectiveCamera(24, 1, 0.01, 20);
  compare: Compare = "off";
  /** share of the width left of the divider */
  split = 0.5;
  showsOther = false;
  faces: [ViewedFace, ViewedFace | null] | null = null;
  /** called before each drawing */
  before: () => void = () => {};
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly controls: OrbitControls;
  private wanted = false;

  /** @throws Error a browser without WebGL */
  constructor(private readonly holder: HTMLElement) {
    this.renderer = new WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.toneMapping = NeutralToneMapping;
    this.renderer.setScissorTest(true);
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("aria-label", "Face in 3D. Arrow keys turn it, plus and minus zoom.");
    this.canvas.setAttribute("role", "img");
    holder.prepend(this.canvas);
    this.scene.background = new Color(0x23272e);
    this.light();
    this.scene.add(this.camera);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.invalidate());
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("webglcontextrestored", () => this.invalidate());
    new ResizeObserver(() => this.resize()).observe(holder);
    this.resize();
  }

  /** Show `own`, and `other` where two are compared. */
  show(own: ViewedFace, other: ViewedFace | null): void {
    this.faces?.forEach((one) => one?.face.root.removeFromParent());
    this.faces = [own, other];
    for (const one of [own, other]) if (one) this.scene.add(one.face.root);
    this.invalidate();
  }

  /** Show nothing. */
  clear(): void {
    this.faces?.forEach((one) => one?.face.root.removeFromParent());
    this.faces = null;
    this.invalidate();
  }

  /** Look at the whole face from the front. */
  frame(): void {
    if (!this.faces) return;
    const box = new Box3();
    for (const mesh of this.faces[0].face.meshes) {
      for (const { geometry, matrixWorld } of mesh.primitives) {
        // where skinning puts it: vertices of others' files may be in any space
        const own = new Box3().setFromBufferAttribute(geometry.getAttribute("paintNeutral") as BufferAttribute);
        box.union(own.applyMatrix4(matrixWorld));
      }
    }
    const [center, size] = [box.getCenter(new Vector3()), box.getSize(new Vector3())];
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const distance = (0.58 * Math.max(size.y, size.x / Math.max(this.camera.aspect, 0.2))) / half + size.z / 2;
    this.camera.near = distance / 50;
    this.camera.far = distance * 20;
    this.camera.updateProjectionMatrix();
    this.controls.target.copy(center);
    this.camera.position.copy(center).add(new Vector3(0.16, 0.05, 1).setLength(distance));
    this.controls.update();
    this.invalidate();
  }

  /** Draw with the next frame. */
  invalidate(): void {
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame(() => {
      this.wanted = false;
      this.draw();
    });
  }

  /** Draw now. */
  draw(): void {
    this.before();
    const { width, height } = this.renderer.domElement;
    const ratio = this.renderer.getPixelRatio();
    const [w, h] = [width / ratio, height / ratio];
    const edge = Math.round(w * this.split);
    if (this.compare === "split" && this.faces?.[1]) {
      this.part(0, 0, edge, h);
      this.part(1, edge, w - edge, h);
    } else {
      this.part(this.compare === "toggle" && this.showsOther ? 1 : 0, 0, w, h);
    }
  }

  /** The picture as a PNG. */
  async png(): Promise<Blob> {
    this.draw();
    return new Promise((resolve, reject) =>
      this.canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("picture: could not be made"))), "image/png"),
    );
  }

  private part(number: number, left: number, width: number, height: number): void {
    this.faces?.forEach((one, i) => one && (one.face.root.visible = i === (this.faces![1] ? number : 0)));
    this.renderer.setScissor(left, 0, width, height);
    this.renderer.render(this.scene, this.camera);
  }

  private light(): void {
    this.scene.add(new HemisphereLight(0xdfe8f5, 0x5a4a40, 1.1));
    const lamps: [number, number, number, number, number][] = [
      [0xfff1e2, 2.3, -0.6, 0.7, 1.2],
      [0xcfe0ff, 0.8, 1.2, 0.2, 0.6],
      [0xffffff, 0.5, 0.5, 0.8, -1.2],
    ];
    for (const [color, strength, x, y, z] of lamps) {
      const lamp = new DirectionalLight(color, strength);
      lamp.position.set(x, y, z);
      this.camera.add(lamp, lamp.target); // light turns with the viewer: every side can be judged
    }
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.invalidate();
  }

  private key(event: KeyboardEvent): void {
    const turns: Record<string, [number, number]> = {
      ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1],
    };
    const zoom = { "+": 0.9, "=": 0.9, "-": 1.1 }[event.key];
    const turn = turns[event.key];
    if (!turn && !zoom) return;
    event.preventDefault();
    const { target } = this.controls;
    const from = this.camera.position.clone().sub(target);
    if (turn) {
      from.applyAxisAngle(new Vector3(0, 1, 0), -0.1 * turn[0]);
      const side = new Vector3(0, 1, 0).cross(from).normalize();
      const tilted = from.clone().applyAxisAngle(side, 0.1 * turn[1]);
      if (Math.abs(tilted.clone().normalize().y) < 0.98) from.copy(tilted);
    }
    this.camera.position.copy(target).add(from.multiplyScalar(zoom ?? 1));
    this.controls.update();
    this.invalidate();
  }
}

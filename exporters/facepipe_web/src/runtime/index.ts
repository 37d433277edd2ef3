/** Faces of facepipe in a browser: `const face = await loadFace(glb, onnx); scene.add(face.root)`. */
export type { ClipInfo } from "./clips";
export { Face, type JointFacts, type SliderInfo } from "./face";
export type { FaceMesh } from "./glb";
export { loadFace, type LoadOptions } from "./load_face";
export type { Metadata } from "./metadata";
export type { Backend, NetworkOptions } from "./network";
export * from "./persons";

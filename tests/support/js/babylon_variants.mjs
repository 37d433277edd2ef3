// The variants of a GLB in Babylon.js, as a game selects them one after the other: of each the colours that its
// primitives show, left to right; of "" those that they show at first.
// usage: node babylon_variants.mjs FILE
import { NullEngine } from "@babylonjs/core/Engines/nullEngine.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Logger } from "@babylonjs/core/Misc/logger.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/2.0/index.js";
import { KHR_materials_variants as Variants } from "@babylonjs/loaders/glTF/2.0/Extensions/KHR_materials_variants.js";
import { bytesOf } from "./poses.mjs";

Logger.LogLevels = Logger.ErrorLogLevel; // stdout is the answer's
const scene = new Scene(new NullEngine());
const bytes = new Uint8Array(bytesOf(process.argv[2]));
const container = await LoadAssetContainerAsync(bytes, scene, { pluginExtension: ".glb" });
container.addAllToScene();
const [root] = container.rootNodes;
const centre = (mesh) => mesh.getBoundingInfo().boundingBox.center.x;
const meshes = container.meshes.filter((one) => one.getTotalVertices()).sort((a, b) => centre(a) - centre(b));
const colors = () => meshes.map((one) => one.material.albedoColor.asArray());
const shown = { "": colors() };
for (const name of Variants.GetAvailableVariants(root)) {
  Variants.SelectVariant(root, name);
  shown[name] = colors();
}
process.stdout.write(JSON.stringify(shown));

// Prints what three-vrm knows of the avatar in a .vrm, of VRM 0.x or 1.0, by names, as JSON; one of 0.x is turned first.
// usage: node vrm_facts.mjs FILE
// answer: {"meta", "bones": {human bone: [name, [x, y, z]]}, "expressions": {name: {...}}, "lookAt", "firstPerson",
//          "springs": [one a joint], "constraints": [...]}; places are in the world
import { readFileSync } from "node:fs";
import { Vector3 } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { VRMLoaderPlugin, VRMUtils } from "@pixiv/three-vrm";

globalThis.self = globalThis;
for (const name of ["warn", "error"]) console[name] = (...words) => { throw new Error(words.join(" ")); };

const bytes = readFileSync(process.argv[2]);
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const { vrm } = (await loader.parseAsync(buffer, "")).userData;
const { humanoid, expressionManager, lookAt, firstPerson, springBoneManager, nodeConstraintManager } = vrm;
VRMUtils.rotateVRM0(vrm);
vrm.scene.updateMatrixWorld(true);

const rounded = (numbers) => numbers.map((one) => Math.round(one * 1e5) / 1e5 + 0);
const place = (object, at = new Vector3()) => rounded(at.clone().applyMatrix4(object.matrixWorld).toArray());
const called = (object) => object.userData.name ?? object.name; // three.js makes names distinct
const owner = (mesh) => called(mesh.parent?.isGroup && mesh.parent !== vrm.scene ? mesh.parent : mesh);
const sorted = (list) => list.map((one) => [JSON.stringify(one), one]).sort(([a], [b]) => (a < b ? -1 : a > b ? 1 : 0)).map(([, one]) => one);

const bound = (bind) => {
  if ("primitives" in bind) return { mesh: owner(bind.primitives[0]), index: bind.index, weight: rounded([bind.weight])[0] };
  const { material, type, targetValue, targetAlpha, scale, offset } = bind;
  return type
    ? { material: material.name, type, value: rounded([...targetValue.toArray(), targetAlpha]) }
    : { material: material.name, scale: rounded(scale.toArray()), offset: rounded(offset.toArray()) };
};
const range = (map) => rounded([map.inputMaxValue, map.outputScale]);

console.log(JSON.stringify({
  meta: vrm.meta,
  bones: Object.fromEntries(
    Object.entries(humanoid.humanBones).filter(([, one]) => one?.node).map(([bone, { node }]) => [bone, [node.name, place(node)]]),
  ),
  expressions: Object.fromEntries(
    expressionManager.expressions.map((one) => [one.expressionName, {
      isBinary: one.isBinary, blink: one.overrideBlink, lookAt: one.overrideLookAt, mouth: one.overrideMouth,
      // three-vrm has one for each copy that three.js made of a material
      binds: sorted(one.binds.map(bound)).filter((bind, i, all) => JSON.stringify(bind) !== JSON.stringify(all[i - 1])),
    }]),
  ),
  lookAt: lookAt && {
    type: lookAt.applier.constructor.type,
    from: place(humanoid.getRawBoneNode("head"), lookAt.offsetFromHeadBone),
    ranges: ["HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp"].map((one) => range(lookAt.applier[`rangeMap${one}`])),
  },
  firstPerson: firstPerson && sorted(firstPerson.meshAnnotations.map(({ meshes, type }) => [owner(meshes[0]), type])),
  springs: springBoneManager && sorted([...springBoneManager.joints].map(({ bone, child, settings, colliderGroups, center }) => ({
    bone: bone.name,
    end: child ? place(child) : place(bone, bone.position.clone().normalize().multiplyScalar(0.07)),
    settings: rounded([settings.hitRadius, settings.stiffness, settings.gravityPower, settings.dragForce]),
    gravity: rounded(settings.gravityDir.toArray()),
    center: center?.name ?? null,
    colliders: colliderGroups.map(({ colliders }) => colliders.map((one) => {
      const { type, offset, tail, normal, radius } = one.shape;
      return [type, place(one, offset), tail ? place(one, tail) : null, normal ? rounded(normal.toArray()) : null, rounded([radius ?? 0])];
    })),
  }))),
  constraints: nodeConstraintManager && sorted([...nodeConstraintManager.constraints].map((one) => (
    [one.constructor.name, one.destination.name, one.source.name, rounded([one.weight]), one.rollAxis ?? one.aimAxis ?? null]
  ))),
}));

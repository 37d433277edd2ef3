/** The skeleton drawn over the face. */
import { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineSegments, Points, PointsMaterial } from "three";
import type { Face } from "../runtime";

export class BonesOverlay {
  readonly group = new Group();
  private readonly lines = new BufferGeometry();
  private readonly dots = new BufferGeometry();

  constructor(private readonly face: Face) {
    const joints = face.joints;
    const count = joints?.bones.length ?? 0;
    const links = joints?.parents.filter((parent) => parent >= 0).length ?? 0;
    this.lines.setAttribute("position", new BufferAttribute(new Float32Array(6 * links), 3));
    this.dots.setAttribute("position", new BufferAttribute(new Float32Array(3 * count), 3));
    const seen = { depthTest: false, depthWrite: false, transparent: true };
    const lines = new LineSegments(this.lines, new LineBasicMaterial({ color: 0x6cb4f0, opacity: 0.8, ...seen }));
    const dots = new Points(this.dots, new PointsMaterial({ color: 0xffffff, size: 5, sizeAttenuation: false, ...seen }));
    for (const one of [lines, dots]) {
      one.renderOrder = 10;
      one.frustumCulled = false;
      this.group.add(one);
    }
    this.group.visible = false;
    face.root.add(this.group);
  }

  /** Follow the joints. */
  update(): void {
    const { joints } = this.face;
    if (!joints || !this.group.visible) return;
    const [lines, dots] = [this.lines.attributes.position, this.dots.attributes.position];
    let end = 0;
    const place = (joint: number) => joints.bones[joint].matrix.elements.slice(12, 15) as [number, number, number];
    joints.parents.forEach((parent, joint) => {
      dots.setXYZ(joint, ...place(joint));
      if (parent < 0) return;
      lines.setXYZ(end++, ...place(parent));
      lines.setXYZ(end++, ...place(joint));
    });
    lines.needsUpdate = dots.needsUpdate = true;
  }
}

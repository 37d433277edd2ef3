/** The line between two faces, and what stands on its sides. */
import { h } from "./dom";
import type { Picture } from "./scene";

export class Divider {
  readonly elements: HTMLElement[];
  private readonly bar: HTMLElement;
  private readonly sides: HTMLElement[];

  constructor(
    private readonly picture: Picture,
    private readonly holder: HTMLElement,
  ) {
    const label = "Divider between the faces; arrow keys move it";
    this.bar = h("div", { class: "divider", role: "separator", tabIndex: 0, "aria-label": label, "aria-orientation": "vertical", hidden: true });
    this.sides = [h("div", { class: "side", hidden: true }), h("div", { class: "side", hidden: true })];
    this.elements = [this.bar, ...this.sides];
    this.bar.addEventListener("pointerdown", (event) => this.bar.setPointerCapture(event.pointerId));
    this.bar.addEventListener("pointermove", (event) => {
      if (this.bar.hasPointerCapture(event.pointerId)) {
        const { left, width } = this.holder.getBoundingClientRect();
        this.move((event.clientX - left) / width);
      }
    });
    this.bar.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (step) this.move(this.picture.split + step);
    });
  }

  /** Follow the picture's way to compare. */
  update(labels: [string, string]): void {
    const { compare, split, showsOther } = this.picture;
    this.bar.hidden = compare !== "split";
    this.bar.style.left = `${100 * split}%`;
    this.bar.setAttribute("aria-valuenow", String(Math.round(100 * split)));
    this.sides[0].hidden = compare === "off" || (compare === "toggle" && showsOther);
    this.sides[1].hidden = compare === "off" || (compare === "toggle" && !showsOther);
    this.sides.forEach((side, i) => (side.textContent = `${"AB"[i]} · ${labels[i]}`));
    this.sides[0].style.right = compare === "split" ? `calc(${100 * (1 - split)}% + 16px)` : "45%";
    this.sides[1].style.left = compare === "split" ? `calc(${100 * split}% + 16px)` : "45%";
    this.labels = labels;
  }

  private labels: [string, string] = ["", ""];

  private move(split: number): void {
    this.picture.split = Math.min(Math.max(split, 0.02), 0.98);
    this.update(this.labels);
    this.picture.invalidate();
  }
}

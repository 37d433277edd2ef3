/** The 68 landmarks on a photo: seen, and moved by mouse, touch or keys. */
import { h } from "../viewer/dom";

/** As `facepipe fit-photo --landmarks` takes them; pixels of the photo seen upright. */
export interface Landmarks {
  multipie68: [number, number][];
  confidence?: number[];
  units: string;
}

const LINES = [[0, 16], [17, 21], [22, 26], [27, 30], [31, 35], [36, 41, 36], [42, 47, 42], [48, 59, 48], [60, 67, 60]]; // first, last, again
const ROOM = 0.35; // of the landmarks' box around it
const NAMES = ["jaw", "right brow", "left brow", "nose", "nostrils", "right eye", "left eye", "lips", "inner lips"];
const STEP = 1 / 400; // of the picture that an arrow key moves one
const KEYS: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class LandmarkEditor {
  readonly element: HTMLElement;
  private readonly marks: SVGCircleElement[] = [];
  private readonly lines: SVGPolylineElement[];
  private readonly svg = svg("svg", {});
  private readonly width: number;

  /**
   * @param photo seen upright
   * @param found are changed where they are moved
   * @param settled one was let go of
   */
  constructor(
    photo: ImageBitmap,
    private found: Landmarks,
    private readonly settled: () => void,
  ) {
    const places = found.multipie68;
    const [low, high] = [0, 1].map((axis) => places.map((one) => one[axis])).reduce<[number[], number[]]>(
      ([lows, highs], values) => [[...lows, Math.min(...values)], [...highs, Math.max(...values)]], [[], []],
    );
    const room = ROOM * Math.max(high[0] - low[0], high[1] - low[1]);
    const [left, top] = low.map((one) => Math.floor(Math.max(one - room, 0)));
    const width = (this.width = Math.ceil(Math.min(high[0] + room, photo.width)) - left);
    const height = Math.ceil(Math.min(high[1] + room, photo.height)) - top;
    const canvas = h("canvas", { width, height });
    canvas.getContext("2d")!.drawImage(photo, left, top, width, height, 0, 0, width, height);
    this.svg.setAttribute("viewBox", `${left} ${top} ${width} ${height}`);
    this.lines = LINES.map(() => svg("polyline", {}));
    this.svg.append(...this.lines);
    places.forEach((_, number) => this.mark(number));
    this.element = h("div", { class: "shot" }, canvas, this.svg);
    this.show(found);
  }

  /** Show landmarks, which are changed from now on. */
  show(found: Landmarks): void {
    this.found = found;
    found.multipie68.forEach(([x, y], number) => {
      this.marks[number].setAttribute("cx", String(x));
      this.marks[number].setAttribute("cy", String(y));
    });
    this.lines.forEach((line, i) => {
      const [first, last, again] = LINES[i];
      const row = found.multipie68.slice(first, last + 1);
      line.setAttribute("points", [...row, ...(again === undefined ? [] : [row[0]])].join(" "));
    });
  }

  private mark(number: number): void {
    const part = LINES.findIndex(([first, last]) => number >= first && number <= last);
    const label = `${NAMES[part]} ${number - LINES[part][0] + 1}`;
    const mark = svg("circle", { r: this.width / 160, tabindex: 0, role: "button", "aria-label": label, "data-mark": number });
    mark.addEventListener("pointerdown", (event) => {
      mark.setPointerCapture(event.pointerId);
      event.preventDefault();
      mark.focus();
    });
    mark.addEventListener("pointermove", (event) => {
      if (!mark.hasPointerCapture(event.pointerId)) return;
      const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM()!.inverse());
      this.move(number, x, y);
    });
    mark.addEventListener("lostpointercapture", () => this.settled());
    mark.addEventListener("keydown", (event) => {
      const way = KEYS[event.key];
      if (!way) return;
      event.preventDefault();
      const [x, y] = this.found.multipie68[number];
      this.move(number, x + way[0] * STEP * this.width, y + way[1] * STEP * this.width);
      this.settled();
    });
    this.marks.push(mark);
    this.svg.append(mark);
  }

  /** Who moves one is sure of it. */
  private move(number: number, x: number, y: number): void {
    const { viewBox } = this.svg as unknown as SVGSVGElement;
    const { x: left, y: top, width, height } = viewBox.baseVal;
    this.found.multipie68[number] = [Math.min(Math.max(x, left), left + width), Math.min(Math.max(y, top), top + height)];
    if (this.found.confidence) this.found.confidence[number] = 1;
    this.show(this.found);
  }
}

function svg<Tag extends keyof SVGElementTagNameMap>(tag: Tag, attributes: Record<string, string | number>): SVGElementTagNameMap[Tag] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  return element;
}

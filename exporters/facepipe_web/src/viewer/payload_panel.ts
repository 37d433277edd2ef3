/** Bone coefficients (.fpb) opened in the page: shown, and played where they are a clip. */
import { type Face, parsePayload, type Payload } from "../runtime";
import { h } from "./dom";
import { sayError } from "./messages";
import { section } from "./panels";
import { Row } from "./rows";

const STEP = 1 / 24; // seconds between frames that have no times

export class PayloadPanel {
  readonly element: HTMLElement;
  private readonly info = h("p", {}, "Bone coefficients of a server or of facepipe fit-bones; drop a .fpb file here too.");
  private readonly controls = h("div", {});
  private payload: Payload | null = null;
  private shown = 0; // frame
  private playing = false;
  private row: Row | null = null;

  constructor(
    private readonly face: () => Face,
    private readonly changed: () => void,
  ) {
    const file = h("input", { type: "file", accept: ".fpb", hidden: true, id: "payload" });
    file.addEventListener("change", () => file.files?.[0] && void this.open(file.files[0]));
    const open = h("button", { onclick: () => file.click() }, "Open .fpb");
    this.element = section("Payload", open, file, this.info, this.controls);
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      const dropped = event.dataTransfer?.files[0];
      if (dropped) void this.open(dropped);
    });
  }

  async open(file: File): Promise<void> {
    try {
      const payload = parsePayload(await file.arrayBuffer(), file.name);
      await this.face().setPayload(payload, 0);
      this.payload = payload;
      this.shown = 0;
      this.describe(file.name);
      this.changed();
    } catch (error) {
      sayError(error);
    }
  }

  /** Take the payload off. */
  async close(): Promise<void> {
    this.payload = null;
    this.playing = false;
    this.info.textContent = "";
    this.controls.replaceChildren();
    await this.face().setPayload(null);
    this.changed();
  }

  /** Put it on another face in place of the first. */
  async again(): Promise<void> {
    if (this.payload) await this.frame(this.shown);
  }

  private describe(name: string): void {
    const { frames, times, jointCount } = this.payload!;
    const seconds = times ? `, ${(times[times.length - 1] - times[0]).toFixed(2)} s` : "";
    this.info.textContent = `${name}: ${frames.length} frame${frames.length > 1 ? "s" : ""}${seconds}, ${jointCount} joints`;
    const off = h("button", { onclick: () => void this.close() }, "Take off");
    this.controls.replaceChildren(off);
    if (frames.length < 2) return;
    const play = h("button", { "aria-pressed": false }, "Play");
    play.addEventListener("click", () => {
      this.playing = !this.playing;
      play.setAttribute("aria-pressed", String(this.playing));
      if (this.playing) this.run(performance.now());
    });
    const change = (at: number) => void this.frame(Math.round(at));
    this.row = new Row({ name: "frame", minimum: 0, maximum: frames.length - 1, rest: 0, value: 0, change });
    this.controls.replaceChildren(play, " ", off, this.row.element);
  }

  private async frame(number: number): Promise<void> {
    this.shown = number;
    await this.face().setPayload(this.payload, number).catch(sayError);
    this.changed();
  }

  /** Play in real time, over and over. */
  private run(start: number): void {
    const payload = this.payload;
    if (!this.playing || !payload) return;
    const times = payload.times ?? payload.frames.map((_, i) => i * STEP);
    const length = times[times.length - 1] - times[0] + STEP;
    const at = times[0] + (((performance.now() - start) / 1000) % length);
    let number = times.length - 1;
    while (number > 0 && times[number] > at) number--;
    this.row?.show(number);
    void this.frame(number).then(() => requestAnimationFrame(() => this.run(start)));
  }
}

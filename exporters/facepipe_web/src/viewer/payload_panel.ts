/** Payloads (.fpb) opened in the page: who the face is, or bone coefficients, played where they are a clip. */
import { type Basis, type Face, isPerson, parsePayload, parsePerson, type Payload, type Person, readBasis } from "../runtime";
import { fetched } from "../runtime/errors";
import { h } from "./dom";
import { sayError } from "./messages";
import { section } from "./panels";
import { Row } from "./rows";

const STEP = 1 / 24; // seconds between frames that have no times

export class PayloadPanel {
  readonly element: HTMLElement;
  private readonly info = h("p", {}, "A person, or bone coefficients, of a server or of facepipe; drop a .fpb file here too.");
  private readonly controls = h("div", {});
  private payload: Payload | null = null;
  private person: Person | null = null;
  private basis: Basis | null = null;
  private shown = 0; // frame
  private playing = false;
  private row: Row | null = null;

  constructor(
    private readonly face: () => Face,
    private readonly basisUrl: string,
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
      const bytes = await file.arrayBuffer();
      if (isPerson(bytes)) await this.openPerson(bytes, file.name);
      else {
        const payload = parsePayload(bytes, file.name);
        await this.face().setPayload(payload, 0);
        this.payload = payload;
        this.shown = 0;
        this.describe(file.name);
      }
      this.changed();
    } catch (error) {
      sayError(error);
    }
  }

  private async openPerson(bytes: ArrayBuffer, name: string): Promise<void> {
    const person = parsePerson(bytes, name);
    await this.wear(person);
    this.person = person;
    this.info.textContent = `${name}: a person in ${bytes.byteLength} bytes`;
    this.controls.replaceChildren(this.off());
  }

  private async wear(person: Person): Promise<void> {
    this.basis ??= await readBasis(await (await fetched(this.basisUrl)).arrayBuffer(), "basis");
    await this.face().setPerson(person, this.basis);
  }

  /** Take payload and person off. */
  async close(): Promise<void> {
    this.payload = this.person = null;
    this.playing = false;
    this.info.textContent = "";
    this.controls.replaceChildren();
    await this.face().setPayload(null);
    await this.face().setPerson(null);
    this.changed();
  }

  /** Put them on another face in place of the first. */
  async again(): Promise<void> {
    if (this.person) await this.wear(this.person).catch(sayError);
    if (this.payload) await this.frame(this.shown);
  }

  private describe(name: string): void {
    const { frames, times, jointCount } = this.payload!;
    const seconds = times ? `, ${(times[times.length - 1] - times[0]).toFixed(2)} s` : "";
    this.info.textContent = `${name}: ${frames.length} frame${frames.length > 1 ? "s" : ""}${seconds}, ${jointCount} joints`;
    const off = this.off();
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

  private off(): HTMLElement {
    return h("button", { onclick: () => void this.close() }, "Take off");
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

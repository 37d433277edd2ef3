/** The clips of a face, played: one at a time, over and over or once, at any moment. */
import type { ClipInfo, Face } from "../runtime";
import { h } from "../viewer/dom";
import { sayError } from "../viewer/messages";
import { Row } from "../viewer/rows";

export class ClipPlayer {
  readonly element = h("div", { class: "clips" });
  private clip: ClipInfo | null = null;
  private row: Row | null = null;
  private readonly play = h("button", { "aria-pressed": false, onclick: () => this.toggle() }, "Play");
  private readonly loop = h("input", { type: "checkbox", checked: true });
  private at = 0; // seconds on the clip's own clock
  private playing = false;

  /** @param changed the face has moved */
  constructor(
    private readonly face: Face,
    private readonly changed: () => void,
  ) {
    const names = h("select", { "aria-label": "Clip" }, h("option", { value: "" }, "none"), ...face.clips.map(({ name }) => h("option", {}, name)));
    names.addEventListener("change", () => this.choose(names.value));
    this.element.append(names);
    this.element.hidden = !face.clips.length;
  }

  /** Take a clip from its start; "": none. */
  choose(name: string): void {
    const [names] = this.element.children as unknown as [HTMLSelectElement];
    names.value = name;
    this.pause();
    this.clip = this.face.clips.find((one) => one.name === name) ?? null;
    this.row = null;
    this.element.replaceChildren(names);
    if (!this.clip) return void this.face.setClip(null).then(this.changed, sayError);
    const { start, end } = this.clip;
    const change = (value: number) => {
      this.pause();
      void this.seek(value);
    };
    this.row = new Row({ name: "seconds", minimum: start, maximum: end, rest: start, value: start, change });
    const buttons = h("div", { class: "buttons" }, this.play, h("label", {}, this.loop, " Over and over"));
    this.element.append(buttons, this.row.element);
    void this.seek(start);
  }

  toggle(): void {
    if (this.playing) return this.pause();
    if (!this.clip) return;
    if (this.at >= this.clip.end) this.at = this.clip.start;
    this.playing = true;
    this.play.setAttribute("aria-pressed", "true");
    this.play.textContent = "Pause";
    this.run(this.clip, performance.now());
  }

  pause(): void {
    this.playing = false;
    this.play.setAttribute("aria-pressed", "false");
    this.play.textContent = "Play";
  }

  /** In real time, as far as frames are drawn. */
  private run(clip: ClipInfo, before: number): void {
    requestAnimationFrame((now) => {
      if (!this.playing || clip !== this.clip) return;
      const { start, end } = clip;
      let at = this.at + Math.max(0, now - before) / 1000;
      if (at > end && this.loop.checked) at = start + ((at - start) % (end - start));
      void this.seek(Math.min(at, end)).then(() => (at < end ? this.run(clip, now) : this.pause()));
    });
  }

  private async seek(seconds: number): Promise<void> {
    this.at = seconds;
    this.row?.show(seconds);
    await this.face.setClip(this.clip!.name, seconds).catch(sayError);
    this.changed();
  }
}

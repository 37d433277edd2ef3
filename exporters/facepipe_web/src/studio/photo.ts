/** A face from a photo: taken or dropped, with consent, fitted by a job; then edited, downloaded or deleted. */
import { h } from "../viewer/dom";
import { sayError } from "../viewer/messages";
import { ask, download, type Face, fileOf, get, newest } from "./api";
import type { Studio } from "./main";
import { act, fileButton, onDrop, type Part, work } from "./work";

/** Changes with the text: the server keeps which one was agreed to, and when. */
const CONSENT = "2026-11";
const TEXT =
  "The photo is used to find the shape and the skin of the face in it, on this server alone, and deleted when that is done. " +
  "The face that is made, its skin too, can tell who it is of: it is kept until you delete it. " +
  "Send only photos of yourself, or of somebody who has agreed to this.";
const PHOTOS = "image/jpeg,image/png,image/webp,image/heic";

export class Photo implements Part {
  readonly title = "Photo";
  private photo: File | null = null;
  private face: Face | null = null;
  private readonly preview = h("img", { class: "photo", alt: "The photo to be used", hidden: true });
  private readonly agreed = h("input", { type: "checkbox", id: "agreed" });
  private readonly start = h("button", { class: "main", disabled: true, onclick: () => void this.fit() }, "Make the face");
  private readonly result = h("section", { "aria-label": "Result", hidden: true });
  private readonly page: HTMLElement;

  constructor(private readonly studio: Studio) {
    const take = fileButton("Take a photo", { accept: PHOTOS, capture: "user" }, ([file]) => this.use(file));
    const choose = fileButton("Choose a file …", { accept: PHOTOS }, ([file]) => this.use(file));
    this.agreed.addEventListener("change", () => this.update());
    this.page = h(
      "div",
      {},
      h("header", {}, h("h1", {}, "Photo"), h("p", {}, "From the front, a plain expression, even light.")),
      h("section", { "aria-label": "The photo", class: "drop" }, this.preview, h("div", { class: "buttons" }, take, choose), h("p", {}, "Or drop one here.")),
      h("section", { "aria-label": "Consent" }, h("p", { id: "consent" }, TEXT), h("label", { class: "check", for: "agreed" }, this.agreed, ` I agree (text of ${CONSENT})`), h("div", { class: "buttons" }, this.start)),
      this.result,
    );
    onDrop(this.page, ([file]) => this.use(file));
  }

  async show(): Promise<void> {
    this.studio.page(null);
    this.studio.panel.replaceChildren(this.page);
    const { bench } = this.studio;
    try {
      if (this.face) await bench.open(newest(this.face), this.face.name);
      else {
        await bench.clear();
        bench.say("The face appears here.");
      }
    } catch (error) {
      sayError(error);
    }
  }

  hide(): void {}

  private use(file: File): void {
    URL.revokeObjectURL(this.preview.src);
    this.photo = file;
    this.preview.src = URL.createObjectURL(file);
    this.preview.hidden = false;
    this.update();
  }

  private update(): void {
    this.start.disabled = !this.photo || !this.agreed.checked;
  }

  private async fit(): Promise<void> {
    const { photo } = this;
    if (!photo) return;
    this.start.disabled = true;
    try {
      const headers = { "Content-Type": photo.type || "application/octet-stream", "X-Facepipe-Consent": CONSENT };
      const sent = (await (await ask("photos", { method: "POST", headers, body: photo })).json()) as { artefact: string };
      const name = photo.name.replace(/\.\w+$/, "") || "Photo";
      const job = await work("Finding the face", act("fit-photo", { photos: [sent.artefact] }, { name }));
      if (!job?.face) return;
      this.face = await get<Face>(`faces/${job.face}`);
      this.fill(this.face);
      await this.show();
      document.body.dataset.saved = `${job.face}/${job.version}`;
    } catch (error) {
      sayError(error);
    } finally {
      this.update();
    }
  }

  private fill(face: Face): void {
    const save = (what: string, ending: string) => () => void download(fileOf(newest(face), what), `${face.name}${ending}`).catch(sayError);
    this.result.replaceChildren(
      h("h2", {}, face.name),
      h(
        "div",
        { class: "buttons" },
        h("button", { class: "main", onclick: () => void this.studio.editSliders(face) }, "Edit sliders"),
        h("button", { onclick: save("face.glb", ".glb") }, "Download GLB"),
        h("button", { onclick: save("face.fpb", ".fpb") }, "Download payload"),
        h("button", { class: "danger", onclick: () => void this.remove(face) }, "Delete it"),
      ),
    );
    this.result.hidden = false;
  }

  private async remove(face: Face): Promise<void> {
    if (!confirm(`Delete ${face.name} with all that was made of the photo?`)) return;
    try {
      await ask(`faces/${face.id}`, { method: "DELETE" });
      URL.revokeObjectURL(this.preview.src);
      this.preview.removeAttribute("src");
      this.preview.hidden = this.result.hidden = true;
      this.face = this.photo = null;
      this.update();
      await this.show();
    } catch (error) {
      sayError(error);
    }
  }
}

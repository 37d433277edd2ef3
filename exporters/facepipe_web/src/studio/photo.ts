/** A face from a photo: taken or dropped, with consent, its landmarks mended, fitted by a job; then edited, downloaded or deleted. */
import { h } from "../viewer/dom";
import { say, sayError } from "../viewer/messages";
import { ask, download, type Face, fileOf, get, newest } from "./api";
import { History } from "./history";
import { LandmarkEditor, type Landmarks } from "./landmarks";
import type { Studio } from "./main";
import { act, fileButton, onDrop, type Part, sendFile, UndoButtons, work } from "./work";

/** Changes with the text: the server keeps which one was agreed to, and when. */
const CONSENT = "2026-11";
const TEXT =
  "The photo is used to find the shape and the skin of the face in it, on this server alone, and deleted when that is done, after an hour at most. " +
  "The face that is made, its skin too, can tell who it is of: it is kept until you delete it. " +
  "Send only photos of yourself, or of somebody who has agreed to this.";
const PHOTOS = "image/jpeg,image/png,image/webp,image/heic";

export class Photo implements Part {
  readonly title = "Photo";
  private photo: File | null = null;
  private sent: Promise<string> | null = null; // its id, until a job has used it
  private face: Face | null = null;
  private found: Landmarks | null = null;
  private editor: LandmarkEditor | null = null;
  private shown = false;
  private history = new History<Landmarks | null>(null, () => this.undo.update());
  private readonly undo: UndoButtons<Landmarks | null> = new UndoButtons<Landmarks | null>(
    () => this.history,
    (found) => found && this.editor?.show((this.found = found)),
    () => this.shown && this.editor !== null,
  );
  private readonly preview = h("img", { class: "photo", alt: "The photo to be used", hidden: true });
  private readonly agreed = h("input", { type: "checkbox", id: "agreed" });
  private readonly look = h("button", { class: "main", disabled: true, onclick: () => void this.find() }, "Find the face");
  private readonly start = h("button", { class: "main", onclick: () => void this.fit() }, "Make the face");
  private readonly marks: HTMLElement;
  private readonly consent: HTMLElement;
  private readonly result = h("section", { "aria-label": "Result", hidden: true });
  private readonly page: HTMLElement;

  constructor(private readonly studio: Studio) {
    const take = fileButton("Take a photo", { accept: PHOTOS, capture: "user" }, ([file]) => this.use(file));
    const choose = fileButton("Choose a file …", { accept: PHOTOS }, ([file]) => this.use(file));
    this.agreed.addEventListener("change", () => this.update());
    this.marks = h("section", { "aria-label": "Landmarks", hidden: true }, h("h2", {}, "Landmarks"), h("p", {}, "Drag those that lie wrong; arrow keys move the one that was touched."), h("div", { class: "buttons" }, ...this.undo.elements, this.start));
    this.consent = h("section", { "aria-label": "Consent" }, h("p", { id: "consent" }, TEXT), h("label", { class: "check", for: "agreed" }, this.agreed, ` I agree (text of ${CONSENT})`), h("div", { class: "buttons" }, this.look));
    this.page = h(
      "div",
      {},
      h("header", {}, h("h1", {}, "Photo"), h("p", {}, "From the front, a plain expression, even light.")),
      h("section", { "aria-label": "The photo", class: "drop" }, this.preview, h("div", { class: "buttons" }, take, choose), h("p", {}, "Or drop one here.")),
      this.consent,
      this.marks,
      this.result,
    );
    onDrop(this.page, ([file]) => this.use(file));
  }

  async show(): Promise<void> {
    this.shown = true;
    this.studio.panel.replaceChildren(this.page);
    if (this.editor) return this.studio.page(this.editor.element);
    this.studio.page(null);
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

  hide(): void {
    this.shown = false;
  }

  /** Another photo, for another face. */
  private use(file: File): void {
    this.forget();
    this.photo = file;
    this.preview.src = URL.createObjectURL(file);
    this.preview.hidden = false;
    this.update();
    if (this.shown) void this.show();
  }

  private forget(): void {
    this.sent?.then((id) => ask(`photos/${id}`, { method: "DELETE" })).catch(() => undefined); // an hour deletes it too
    URL.revokeObjectURL(this.preview.src);
    this.preview.removeAttribute("src");
    this.preview.hidden = this.marks.hidden = this.result.hidden = true;
    this.consent.hidden = false;
    this.photo = this.sent = this.face = this.editor = this.found = null;
  }

  private update(): void {
    this.look.disabled = !this.photo || !this.agreed.checked;
  }

  /** Send the photo, unless the server still has it. */
  private send(photo: File): Promise<string> {
    if (this.sent) return this.sent;
    const headers = { "Content-Type": photo.type || "application/octet-stream", "X-Facepipe-Consent": CONSENT };
    const posted = async () => ((await (await ask("photos", { method: "POST", headers, body: photo })).json()) as { artefact: string }).artefact;
    const sent = (this.sent = posted());
    sent.catch(() => this.sent === sent && (this.sent = null)); // to be sent again
    return sent;
  }

  /** Find the landmarks, to be looked at before the fit. */
  private async find(): Promise<void> {
    const { photo } = this;
    if (!photo) return;
    this.look.disabled = true;
    this.studio.page(null);
    this.studio.bench.say("Looking for the face …");
    try {
      const sent = await this.send(photo);
      if (photo !== this.photo) return;
      const found = await get<Landmarks>(`photos/${sent}/landmarks`);
      if (photo !== this.photo) return;
      this.found = found;
      this.history = new History<Landmarks | null>(found, () => this.undo.update());
      this.undo.update();
      this.marks.hidden = false;
      this.consent.hidden = true;
      const bitmap = await createImageBitmap(photo).catch(() => null); // upright, as the server sees it
      if (!bitmap) say("This browser can't show such photos, so landmarks can't be moved; the face can be made.");
      this.editor = bitmap && new LandmarkEditor(bitmap, found, () => this.history.keep(this.found));
      bitmap?.close();
      if (this.shown) await this.show();
      document.body.dataset.landmarks = "found";
    } catch (error) {
      if (photo === this.photo) sayError(error);
    } finally {
      if (photo === this.photo) this.studio.bench.say(null);
      this.update();
    }
  }

  private async fit(): Promise<void> {
    const { photo } = this;
    if (!photo) return;
    this.start.disabled = true;
    const drawn = h("img", { class: "shot", alt: "The fit so far", hidden: true });
    try {
      const photos = [await this.send(photo)];
      if (photo !== this.photo) return;
      // the server's own landmarks come with more than these 68: they are sent where somebody knew better
      const landmarks = this.history.canUndo ? [await sendFile(new Blob([JSON.stringify(this.found)]), ".json")] : [];
      const name = photo.name.replace(/\.\w+$/, "") || "Photo";
      const into = this.face ? { face: this.face.id, from: this.face.version } : { name };
      this.sent = null;
      const job = await work("Making the face", act("fit-photo", { photos, landmarks }, into), (url) => {
        drawn.src = url;
        drawn.hidden = false;
        document.body.dataset.preview = "shown";
        if (this.shown && photo === this.photo && !drawn.isConnected) this.studio.page(drawn);
      });
      if (photo !== this.photo) return; // that of the photo before is in the library
      if (!job?.face) return await this.show();
      this.face = await get<Face>(`faces/${job.face}`);
      this.fill(this.face);
      this.editor = null;
      this.marks.hidden = true;
      await this.show();
      document.body.dataset.saved = `${job.face}/${job.version}`;
    } catch (error) {
      sayError(error);
    } finally {
      this.start.disabled = false;
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
      this.forget();
      this.update();
      await this.show();
    } catch (error) {
      sayError(error);
    }
  }
}

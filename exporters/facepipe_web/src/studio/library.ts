/** The library: faces that are kept, uploads by drop, versions, two compared. */
import { h, throttled } from "../viewer/dom";
import { sayError } from "../viewer/messages";
import { ask, type Face, get, newest, Refusal, send, type Source } from "./api";
import type { Studio } from "./main";
import { downloads, fileButton, forgetPictures, onDrop, type Part, thumbnail, upload } from "./work";

const KINDS = ".usd,.usda,.usdc,.usdz,.glb,.gltf,.bin,.vrm,.fbx,.obj,.mtl,.ply,.stl,.off,.fpb,.png,.jpg";

export class Library implements Part {
  readonly title = "Library";
  private readonly grid = h("ul", { class: "faces" });
  private readonly about = h("div", { class: "about" });
  private readonly page = h("div", { class: "library" });
  private chosen: string | null = null;
  private compared: Source[] = [];
  private next: string | null = null;
  private readonly more = h("button", { hidden: true, onclick: () => void this.list(true) }, "More faces");
  private readonly search = h("input", { type: "search", placeholder: "Search faces", "aria-label": "Search faces" });

  constructor(private readonly studio: Studio) {
    this.search.addEventListener("input", throttled(250, () => void this.list()));
    const add = fileButton("Add a face …", { accept: KINDS, multiple: true }, (files) => void this.add(files));
    const head = h("header", {}, h("h1", {}, "Library"), this.search, add);
    const drop = h("p", { class: "drop" }, "Drop a face here: USD, GLB, FBX, VRM, OBJ with its textures, or a .fpb.");
    this.page.append(head, this.grid, this.more, drop);
    onDrop(this.page, (files) => void this.add(files));
  }

  async show(): Promise<void> {
    this.studio.page(this.page);
    this.studio.panel.replaceChildren(this.about);
    await this.list();
  }

  hide(): void {}

  private async add(files: File[]): Promise<void> {
    const job = await upload(files);
    this.chosen = job?.face ?? this.chosen;
    await this.list();
  }

  private async list(more = false): Promise<void> {
    const query = new URLSearchParams({ search: this.search.value.trim() });
    if (more && this.next) query.set("after", this.next);
    try {
      const found = await get<{ faces: Face[]; next: string | null }>(`faces?${query}`);
      this.next = found.next;
      this.more.hidden = !found.next;
      const cards = found.faces.map((face) => this.card(face));
      if (more) this.grid.append(...cards);
      else this.grid.replaceChildren(...cards);
      if (!found.faces.length && !more) this.grid.append(h("li", { class: "empty" }, this.search.value ? "No face is called so." : "No faces yet."));
      const chosen = found.faces.find((face) => face.id === this.chosen) ?? (more ? null : found.faces[0]);
      if (chosen) this.choose(chosen);
      else if (!more) this.about.replaceChildren(h("header", {}, h("p", {}, "Faces that you add are kept here, with all their versions.")));
    } catch (error) {
      sayError(error);
    }
  }

  private card(face: Face): HTMLElement {
    const versions = face.versions.length > 1 ? `${face.versions.length} versions` : face.versions[0].made_by;
    const text = h("span", { class: "name" }, face.name, h("small", {}, versions));
    const button = h("button", { class: "card", "data-face": face.id, onclick: () => this.choose(face) }, thumbnail(newest(face), ""), text);
    return h("li", {}, button);
  }

  private choose(face: Face): void {
    this.chosen = face.id;
    for (const one of this.grid.querySelectorAll<HTMLElement>(".card")) one.setAttribute("aria-current", String(one.dataset.face === face.id));
    const source = newest(face);
    const name = h("input", { type: "text", value: face.name, "aria-label": "Name", maxLength: 200 });
    name.addEventListener("change", () => void this.rename(face, name.value.trim()));
    this.about.replaceChildren(
      h("header", {}, name, h("p", {}, `added ${face.created.slice(0, 10)}`)),
      h(
        "section",
        { "aria-label": "Work on it" },
        h("div", { class: "buttons" },
          h("button", { class: "main", onclick: () => void this.studio.editSliders(face) }, "Edit sliders"),
          h("button", { onclick: () => void this.studio.addToBlend(face) }, "Add to blend")),
      ),
      h("section", { "aria-label": "Download" }, h("h2", {}, "Download"), h("div", { class: "buttons" }, ...downloads(source, face.name))),
      this.versions(face),
      h("section", { "aria-label": "Delete" }, h("button", { class: "danger", onclick: () => void this.remove(face) }, "Delete this face …")),
    );
  }

  private versions(face: Face): HTMLElement {
    const rows = [...face.versions].reverse().map((version) => {
      const source = { face: face.id, version: version.number };
      const is = (one: Source) => one.face === source.face && one.version === source.version;
      const mark = h("input", { type: "checkbox", checked: this.compared.some(is), "aria-label": `Compare ${face.name}, version ${version.number}` });
      mark.addEventListener("change", () => {
        this.compared = mark.checked ? [...this.compared, source].slice(-2) : this.compared.filter((one) => !is(one));
        this.choose(face);
      });
      const conflict = version.conflict_of ? ` · beside ${version.conflict_of}` : "";
      return h("label", { class: "version" }, mark, `${version.number} · ${version.made_by}${conflict}`, h("small", {}, version.created.slice(0, 16).replace("T", " ")));
    });
    const compare = h("button", { disabled: this.compared.length < 2, onclick: () => void this.studio.compare(this.compared) }, "Compare the two");
    const hint = ["Tick two versions, of this face or of others.", "Tick another one.", "Two are ticked."][this.compared.length];
    return h("section", { "aria-label": "Versions" }, h("h2", {}, "Versions"), ...rows, h("p", {}, hint), h("div", { class: "buttons" }, compare));
  }

  private async rename(face: Face, name: string): Promise<void> {
    if (!name || name === face.name) return;
    await send("PATCH", `faces/${face.id}`, { name }).catch(sayError);
    await this.list();
  }

  private async remove(face: Face): Promise<void> {
    if (!confirm(`Delete ${face.name}, all its versions and what was made of them? It can't be brought back.`)) return;
    forgetPictures(face.id);
    try {
      await ask(`faces/${face.id}`, { method: "DELETE" }).catch(async (error: unknown) => {
        if (!(error instanceof Refusal) || error.status !== 409) throw error;
        const known = await Promise.all(error.dependents.map((one) => get<Face>(`faces/${one}`)));
        const names = known.map((one) => one.name).join(", ");
        if (!confirm(`Made of it: ${names}. They stay, but can't be made anew. Delete ${face.name}?`)) return;
        await ask(`faces/${face.id}?dependents=keep`, { method: "DELETE" });
      });
      this.compared = this.compared.filter((one) => one.face !== face.id);
      await this.list();
    } catch (error) {
      sayError(error);
    }
  }
}

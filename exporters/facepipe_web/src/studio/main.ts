/** The studio: its parts, and the picture that they share. */
import { h } from "../viewer/dom";
import { say, sayError } from "../viewer/messages";
import { type Face, get, keepToken, newest, Refusal, sendToken, type Source } from "./api";
import { Bench } from "./bench";
import { Blend } from "./blend";
import { Library } from "./library";
import { Photo } from "./photo";
import { Sliders } from "./sliders";
import type { Part } from "./work";

export class Studio {
  readonly panel = document.getElementById("panel")!;
  readonly view = document.getElementById("view")!;
  readonly bench = new Bench(this.view);
  private readonly library = new Library(this);
  private readonly blend = new Blend(this);
  readonly sliders = new Sliders(this);
  private readonly parts: Part[] = [this.library, this.blend, this.sliders, new Photo(this)];
  private current: Part | null = null;
  private overlay: HTMLElement | null = null;

  constructor() {
    const links = this.parts.map(({ title }) => h("a", { href: `#${title.toLowerCase()}` }, title));
    document.getElementById("parts")!.append(h("strong", {}, "facepipe"), ...links);
    addEventListener("hashchange", () => void this.route());
  }

  async route(): Promise<void> {
    const [name, id] = location.hash.slice(1).split("/");
    const part = this.parts.find(({ title }) => title.toLowerCase() === name) ?? this.library;
    try {
      if (part === this.sliders && id) await this.sliders.openId(id);
      this.current?.hide();
      this.current = part;
      document.title = `${part.title} - facepipe studio`;
      document.body.dataset.part = part.title.toLowerCase();
      for (const link of document.querySelectorAll("#parts > a")) {
        link.toggleAttribute("aria-current", link.textContent === part.title);
      }
      await part.show();
    } catch (error) {
      sayError(error);
    }
  }

  /** Go to a part. */
  go(title: string): void {
    location.hash = `#${title.toLowerCase()}`;
  }

  /** Show a page in place of the picture; null: the picture. */
  page(content: HTMLElement | null): void {
    this.overlay?.remove();
    this.overlay = content;
    if (content) this.view.append(content);
    this.view.classList.toggle("paged", content !== null);
  }

  async editSliders(face: Face): Promise<void> {
    this.sliders.edit(face);
    if (location.hash === "#sliders") await this.route();
    else this.go("Sliders");
  }

  async addToBlend(face: Face): Promise<void> {
    this.blend.add(face);
    this.go("Blend");
  }

  /** Two versions side by side, with a line between them that can be moved. */
  async compare(sources: Source[]): Promise<void> {
    try {
      const names = await Promise.all(sources.map(async ({ face, version }) => `${(await get<Face>(`faces/${face}`)).name} · ${version}`));
      this.page(null);
      const back = h("button", { onclick: () => void this.route() }, "Back to the library");
      this.panel.replaceChildren(h("header", {}, h("h1", {}, "Compare"), h("p", {}, names.join(" and "))), h("section", {}, back));
      if (!(await this.bench.open(sources[0], names[0]))) return;
      await this.bench.open(sources[1], names[1], true);
    } catch (error) {
      sayError(error);
    }
  }
}

/** Who asks: nobody has to say so on the server's own machine. */
async function signIn(): Promise<void> {
  for (;;) {
    try {
      await get("me");
      return;
    } catch (error) {
      if (!(error instanceof Refusal) || error.status !== 401) throw error;
    }
    await new Promise<void>((resolve) => {
      const field = h("input", { type: "password", autocomplete: "off", "aria-label": "Token", required: true });
      const form = h("form", { class: "token" }, h("h1", {}, "Token"), h("p", {}, "This server asks for one: facepipe serve token add NAME"), field, h("button", { class: "main" }, "Go on"));
      form.addEventListener("submit", (event) => {
        event.preventDefault();
        keepToken(field.value.trim());
        form.remove();
        resolve();
      });
      document.body.append(form);
      field.focus();
    });
  }
}

async function start(): Promise<void> {
  sendToken();
  await signIn();
  let studio: Studio;
  try {
    studio = new Studio();
  } catch {
    say("This browser has no WebGL 2, which draws the face: turn on hardware acceleration, or use another browser.");
    return;
  }
  Object.assign(window, { facepipe: { studio, newest } }); // for the console, and for tests
  await studio.route();
  document.body.dataset.state = "ready";
}

start().catch((error) => {
  sayError(error);
  document.body.dataset.state = "failed";
});

/** The viewer's page: reads viewer.json, loads its faces and puts the page together. */
import { FaceError, loadFace } from "../runtime";
import { say, sayError } from "./messages";
import { Page } from "./page";
import { Picture } from "./scene";
import { type FaceEntry, ViewedFace } from "./viewed_face";
import type { BlendEntry } from "./blend_panel";

interface Content {
  faces: FaceEntry[];
  blend: BlendEntry | null;
  basis: string;
}

async function start(): Promise<void> {
  const view = document.getElementById("view")!;
  let picture: Picture;
  try {
    picture = new Picture(view);
  } catch {
    say("This browser has no WebGL 2, which draws the face: turn on hardware acceleration, or use another browser.");
    return;
  }
  const content = (await (await fetch("viewer.json")).json()) as Content;
  const [own, other] = content.faces;
  const face = await load(own);
  const page = new Page(picture, view, document.getElementById("panel")!, face, content.blend, content.basis);
  page.other = other ? await load(other) : null;
  page.show();
  Object.assign(window, { facepipe: { page, face: () => page.own.face, picture, loadFace } }); // for the console, and for tests
  document.body.dataset.state = "ready";
}

/** The face of an entry; without its sliders where the browser or the files don't allow them. */
async function load(entry: FaceEntry): Promise<ViewedFace> {
  try {
    return await ViewedFace.load(entry);
  } catch (error) {
    if (!entry.onnx) throw error;
    say(error instanceof FaceError ? `${entry.label}: ${error.what}` : String(error));
    say(`${entry.label} is shown without its sliders.`);
    return ViewedFace.load({ ...entry, onnx: null });
  }
}

start().catch((error) => {
  sayError(error);
  document.body.dataset.state = "failed";
});

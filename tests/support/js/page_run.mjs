// Runs a page's module as it stands, then sets sliders through it: ENGINE OUT SLIDERS, in the folder of the module.
// OUT gets the points of all vertices, float32 x y z: as the module left them, then with the sliders.
import { writeFileSync } from "node:fs";
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";

const [engine, out, sliders] = process.argv.slice(2);
const page = await import(pathToFileURL(resolve(`${engine}.mjs`)));
const { points } = await import(`./${engine}_points.mjs`);
const found = points(page.container ?? page.scene);
await page.setSliders(JSON.parse(sliders));
found.push(...points(page.container ?? page.scene));
writeFileSync(out, Buffer.concat(found.map((one) => Buffer.from(one.buffer))));

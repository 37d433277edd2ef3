// Opens a page in headless Chromium and takes the steps that it is given, one after another; prints what steps give, as JSON.
// usage: node browse.mjs PLAYWRIGHT CHROMIUM < request
// request: {"url", "flags": [...], "webgpu": folder of onnxruntime-web's build for it, "before": script run before the page's own, "viewport": [width, height], "slower": times that the CPU is,
//           "steps": [{"wait": selector} | {"click": selector} | {"press": key} | {"fill": [selector, text]} |
//                     {"upload": [selector, file or files]} | {"run": expression} | {"hash": selector} | {"picture": file}]}
// answer:  {"results": [one for each step], "problems": [errors and foreign requests of the page]}
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import { pathToFileURL } from "node:url";

const [playwright, executablePath] = process.argv.slice(2);
const { chromium } = await import(pathToFileURL(playwright));
const request = JSON.parse(readFileSync(0, "utf8"));
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", ...(request.flags ?? [])];
const browser = await chromium.launch({ executablePath, headless: true, args });
const results = [];
const problems = [];
try {
  const [width, height] = request.viewport ?? [900, 700];
  const page = await browser.newPage({ viewport: { width, height } });
  page.setDefaultTimeout(60_000);
  if (request.slower) await (await page.context().newCDPSession(page)).send("Emulation.setCPUThrottlingRate", { rate: request.slower });
  page.on("pageerror", (error) => problems.push(`page: ${error.message}`));
  page.on("console", (message) => message.type() === "error" && problems.push(`console: ${message.text()}`));
  page.on("request", (one) => {
    const { protocol, host } = new URL(one.url());
    if (protocol.startsWith("http") && host !== new URL(request.url).host) problems.push(`foreign: ${one.url()}`);
  });
  if (request.webgpu) {
    await page.route("**/*.asyncify.*", (route) => route.fulfill({ path: join(request.webgpu, basename(route.request().url())) }));
  }
  if (request.before) await page.addInitScript(request.before);
  await page.goto(request.url);
  for (const step of request.steps) results.push((await done(page, step)) ?? null);
} finally {
  await browser.close();
}
console.log(JSON.stringify({ results, problems }));

async function done(page, step) {
  if (step.wait) return void (await page.waitForSelector(step.wait, { state: step.state ?? "attached" }));
  if (step.click) return page.click(step.click);
  if (step.press) return page.keyboard.press(step.press);
  if (step.fill) return page.fill(...step.fill);
  if (step.upload) return page.setInputFiles(...step.upload);
  if (step.run) return page.evaluate(step.run);
  if (step.picture) return void (await page.screenshot({ path: step.picture }));
  if (step.hash) return createHash("sha256").update(await page.locator(step.hash).screenshot()).digest("hex");
  throw new Error(`unknown step ${JSON.stringify(step)}`);
}

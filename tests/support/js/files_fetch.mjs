// Lets pages' modules run in node: fetch reads the files beside them (--import this first).
import { readFileSync } from "node:fs";

globalThis.fetch = async (name) => new Response(readFileSync(name));
globalThis.self = globalThis;
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} }); // no pictures in node

// Opens the page on a session of which a relay invents a part, and waits until the page has told of
// all of it, is alive and shows the true part. Run by the test
// `what_a_relay_invents_in_a_browser` of crates/pliant_net/tests/watch.rs:
//
//   node lies.mjs CHROMIUM FOLDER FRAGMENT WRONG...
//
// FOLDER is for the browser's profile, FRAGMENT the end of the link, WRONG parts of what is told.

import assert from "node:assert/strict";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { Browser, serve, sleep, until } from "./browser.mjs";

const [chromium, folder, fragment, ...wanted] = process.argv.slice(2);
const page = await serve(fileURLToPath(new URL("../../crates/pliant_cli/page/static", import.meta.url)));
const browser = new Browser(chromium, join(folder, "profile"));
await browser.open(`${page}#${fragment}`);
await until(browser, `all of ${wanted}`, async () => {
  const told = await browser.value("pliant.wrongs()");
  return wanted.every((part) => told.some((one) => one.includes(part)));
});
await browser.value("pliant.record()");
await until(browser, "the true frames", async () => (await browser.value("pliant.ticks(1).length")) > 10);
// Every text that the page shows from here on, however short the time.
await browser.value(`{
  const line = document.getElementById("status");
  window.shown = new Set();
  new MutationObserver(() => window.shown.add(line.textContent)).observe(line, { childList: true });
}`);
const before = await browser.value("performance.memory.usedJSHeapSize");
await sleep(10_000);
// It goes on: frames are drawn, the page answers, and memory does not grow.
const drawn = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))";
const began = performance.now();
await browser.value(`${drawn}.then(() => true)`);
const answered = performance.now() - began;
const after = await browser.value("performance.memory.usedJSHeapSize");
const shown = await browser.value("[...shown]");
assert.ok(answered < 2000, `a picture after ${answered} ms`);
assert.ok(after < before + 100e6, `${before} bytes, and ${after} after 10 s`);
assert.ok(shown.length > 10, shown);
// What is wrong stands beside what is seen, and never in its place.
for (const status of shown) assert.match(status, /^1 body, .* [0-9]+ wrong: /);
const told = JSON.stringify(await browser.value("pliant.wrongs()"));
console.log(`${told}; status: ${shown.at(-1)}; memory ${(before / 1e6).toFixed(0)} MB, then ${(after / 1e6).toFixed(0)} MB`);
process.exit(0);

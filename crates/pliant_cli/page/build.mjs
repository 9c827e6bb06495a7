// Bundles the page: static/watch.js and static/licenses.txt from src/ and the packages of
// package-lock.json. With --compare it writes nothing and says whether the files are those that it
// would write.

import { createHash } from "node:crypto";
import { existsSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
process.chdir(here);

// The bundle names what it was made from, so that a test without node sees when they differ.
const sources = [
  "build.mjs",
  "package-lock.json",
  ...readdirSync("src")
    .sort()
    .map((name) => `src/${name}`),
];
const hash = createHash("sha256");
for (const name of sources) {
  const contents = readFileSync(name);
  hash.update(`${name} ${contents.length}\n`);
  hash.update(contents);
}

const made = await build({
  entryPoints: ["src/main.ts"],
  bundle: true,
  minify: true,
  format: "esm",
  target: ["chrome114", "firefox130", "safari17"],
  legalComments: "none",
  metafile: true,
  write: false,
  banner: { js: `/* sources ${hash.digest("hex")}; licenses of the packages in it: licenses.txt */` },
});

// The packages in the bundle, with what they say of their licenses.
const packages = new Map();
for (const input of Object.keys(made.metafile.inputs)) {
  const found = /^(node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(input);
  if (found) packages.set(found[1], JSON.parse(readFileSync(join(found[1], "package.json"), "utf8")));
}
let licenses =
  "The file watch.js has these packages in it, under these licenses. Packages without a text of\n" +
  "their own are taken under the Apache License 2.0: https://www.apache.org/licenses/LICENSE-2.0\n";
for (const [folder, about] of [...packages].sort()) {
  licenses += `\n== ${about.name} ${about.version}: ${about.license}\n`;
  const file = ["LICENSE", "LICENSE.md", "LICENSE-MIT"].map((name) => join(folder, name)).find(existsSync);
  const where = typeof about.repository === "string" ? about.repository : about.repository?.url;
  if (where) licenses += `${where.replace(/^git\+|\.git$/g, "")}\n`;
  if (file) licenses += `\n${readFileSync(file, "utf8").replace(/\r/g, "").trim()}\n`;
}

const outputs = [
  ["static/watch.js", made.outputFiles[0].contents],
  ["static/licenses.txt", Buffer.from(licenses)],
];
let same = true;
for (const [name, contents] of outputs) {
  if (existsSync(name) && Buffer.compare(readFileSync(name), contents) === 0) continue;
  same = false;
  if (!process.argv.includes("--compare")) writeFileSync(name, contents);
  else console.error(`${name} is not what the sources give: npm run build`);
}
if (process.argv.includes("--compare") && !same) process.exit(1);

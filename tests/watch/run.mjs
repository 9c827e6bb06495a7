// What tests/watch/run.sh runs: starts everything, measures, and ends everything.

import assert from "node:assert/strict";
import { execFileSync, spawnSync } from "node:child_process";
import { createHash } from "node:crypto";
import { existsSync, mkdirSync } from "node:fs";
import { createServer as createHttpServer } from "node:http";
import { createServer as listen } from "node:net";
import { join } from "node:path";
import { Browser, endAfter, serve, sleep, start, until, within } from "./browser.mjs";
import { expected, extent, overlap, unpacked } from "./silhouette.mjs";

const { RELAY, CHROMIUM, BIN, WORK, OUT } = process.env;
const HZ = 60;
const body = process.env.BODY ?? "pip.modal";

const freePort = () =>
  new Promise((done) => {
    const server = listen();
    server.listen(0, "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => done(port));
    });
  });

const site = join(WORK, "site");
/** A program that is done at once: it fails if it takes longer than `timeout`, ms. */
const limits = { timeout: 30_000, killSignal: "SIGKILL" };
execFileSync(join(BIN, "pliant"), ["watch-page", site], limits);
const pageAddress = await serve(site);

// A certificate that lives longer than a relay: browsers take those of two weeks at most by their
// hash. In a folder of its own: a relay reads it anew after each change beside it.
const tls = join(WORK, "tls");
mkdirSync(tls);
const [key, certificate] = [join(tls, "key.pem"), join(tls, "certificate.pem")];
const names = "subjectAltName=IP:127.0.0.1,DNS:localhost";
const request = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"];
const about = ["-days", "10", "-subj", "/CN=localhost", "-addext", names, "-keyout", key, "-out", certificate];
execFileSync("openssl", [...request, ...about], { stdio: "ignore", ...limits });
const der = execFileSync("openssl", ["x509", "-in", certificate, "-outform", "der"], limits);
const hash = createHash("sha256").update(der).digest("hex");

// Who may do what: the relay asks once for each connection. Only the host's token may publish; who
// has none may watch.
const asked = { host: 0, watcher: 0, refused: 0 };
const auth = createHttpServer((request, answer) => {
  let text = "";
  request.on("data", (data) => (text += data));
  request.on("end", () => {
    const { event, query } = JSON.parse(text);
    if (event !== "connect") return answer.writeHead(200).end("{}");
    const who = query === "jwt=of-the-host" ? "host" : query ? "refused" : "watcher";
    asked[who]++;
    const grant = who === "host" ? { publish: ["tests/**"] } : { subscribe: ["tests/**"] };
    if (who === "refused") answer.writeHead(403).end();
    else answer.writeHead(200, { "content-type": "application/json" }).end(JSON.stringify(grant));
  });
});
await new Promise((done) => auth.listen(0, "127.0.0.1", done));

// What the programs say is told where the test fails.
const said = {};
function listenTo(name, stream) {
  stream.on("data", (data) => (said[name] = `${said[name] ?? ""}${data}`.slice(-4000)));
}

const port = await freePort();
const relayAddress = `https://127.0.0.1:${port}/`;
function startRelay() {
  const where = ["--listen", `127.0.0.1:${port}`, "--listen-tls-cert", certificate, "--listen-tls-key", key];
  const relay = start(RELAY, [...where, "--auth-url", `http://127.0.0.1:${auth.address().port}/`], { stdio: ["ignore", "pipe", "pipe"] });
  listenTo("relay", relay.stdout);
  listenTo("relay", relay.stderr);
  return relay;
}

const trace = join(WORK, "truth");
/** Starts a host, and waits for its link. */
function startHost() {
  const host = start(
    join(BIN, "examples/dedicated_server"),
    ["--bind", "127.0.0.1:0", "--hz", `${HZ}`, "--body", body, "--play", "--trace", trace].concat(
      ["--publish", `${relayAddress}?jwt=of-the-host`, "--link-relay", relayAddress],
      ["--certificate", hash, "--page", pageAddress, "--session", "tests/body"],
    ),
    { stdio: ["ignore", "pipe", "pipe"] },
  );
  listenTo("host", host.stdout);
  listenTo("host", host.stderr);
  let text = "";
  const link = new Promise((done, failed) => {
    host.stdout.on("data", (data) => {
      text += data;
      const found = /^to watch in a browser: (.*)$/m.exec(text);
      if (found) done(found[1]);
    });
    host.on("exit", () => failed(new Error("the host ended")));
  });
  // A host that is killed later has its link.
  link.catch(() => {});
  return { host, link: within(30_000, "the host's link", link) };
}

// Each number is printed as soon as it is known.
const told = new Proxy(
  {},
  {
    set(numbers, name, value) {
      console.log(`${name}: ${value}`);
      numbers[name] = value;
      return true;
    },
  },
);
let relay = startRelay();
let { host, link } = startHost();
const browser = new Browser(CHROMIUM, join(WORK, "profile"));
process.on("uncaughtExceptionMonitor", () => {
  for (const [name, text] of Object.entries(said)) console.error(`the ${name} said: ${text}`);
  console.error(`so far: ${JSON.stringify(told)}; asked: ${JSON.stringify(asked)}`);
});
endAfter(240_000, () => browser.state());
const address = await link;
assert.ok(address.startsWith(pageAddress) && address.includes(hash), address);
assert.ok(!address.includes("of-the-host"), "the host's token is not in the link");
// Without a graphics card the page says so. Whatever it said before stays if it does not.
const none = "HTMLCanvasElement.prototype.getContext = function () { return null; }";
await browser.open(address, none);
const line = "document.getElementById('status')?.textContent";
await until(browser, "a word about the graphics card", async () => /WebGL 2/.test(await browser.value(line)));
await browser.open(address);
await until(browser, "the first picture", () => browser.value("pliant.numbers.firstPicture > 0"));
told.firstPicture = (await browser.value("pliant.numbers.firstPicture")) / 1000;

// Shapes of what was decoded, against the truth of the same ticks.
await browser.value("pliant.record()");
const sofar = () => browser.value("[pliant.numbers.bytes, performance.now()]");
const [bytesBefore, before] = await sofar();
await sleep(8000);
const [bytesAfter, after] = await sofar();
// Bodies and hands, without what a connection costs.
told.bytesPerSecond = ((bytesAfter - bytesBefore) / (after - before)) * 1000;
const [id] = await browser.value("pliant.bodies()");
const ticks = await browser.value(`pliant.ticks(${id})`);
const chosen = ticks.filter((_, k) => k % 8 === 0).slice(0, 24);
assert.ok(chosen.length >= 16, `${ticks.length} frames in 8 s`);
// The host writes its trace in pieces.
await sleep(2000);
const printed = spawnSync(join(BIN, "examples/watch_truth"), [trace, body, ...chosen.map(String)], {
  maxBuffer: 1 << 30,
  ...limits,
});
assert.equal(printed.status, 0, `the truth: ${printed.error ?? printed.stderr}`);
const truth = JSON.parse(printed.stdout);
let [sum, most, moved, furthest, compared] = [0, 0, 0, chosen[0], 0];
let [least, nearest] = [Infinity, chosen[0]];
for (const [tick, positions] of Object.entries(truth.ticks)) {
  const off = await browser.value(`pliant.compare(${id}, ${tick}, ${JSON.stringify(positions)})`);
  assert.ok(off, `the page has no tick ${tick}`);
  compared++;
  sum += off.rms ** 2;
  most = Math.max(most, off.most);
  if (off.moved > moved) [moved, furthest] = [off.moved, Number(tick)];
  if (off.moved < least) [least, nearest] = [off.moved, Number(tick)];
}
assert.ok(compared >= 16, `${compared} ticks are in both`);
Object.assign(told, {
  compared,
  rms: Math.sqrt(sum / compared) / truth.size,
  largest: most / truth.size,
  moved: moved / truth.size,
  frames: ticks.length,
});
await browser.value(`pliant.freeze(${furthest})`);
await sleep(500);
await browser.picture(join(OUT, "page.png"));
told.tick = furthest;
// The host's own picture of that tick, where the program for it is built and something can draw.
const drawer = join(BIN, "examples/watch_picture");
if (OUT !== WORK && existsSync(drawer)) {
  const [wide, high] = await browser.value("[innerWidth, innerHeight]");
  const given = [trace, body, `${furthest}`, join(OUT, "host.png"), `${wide}`, `${high}`];
  told.hostPicture = spawnSync(drawer, given, { stdio: ["ignore", "ignore", "inherit"], timeout: 130_000 }).status === 0;
}

// What the graphics card draws, against what must be seen of the host's truth from the same camera.
const surface = await browser.value(`pliant.surface(${id}, ${furthest})`);
async function picture(shape) {
  const seen = await browser.value("pliant.drawn()");
  const mask = unpacked(seen);
  return { same: overlap(mask, expected(shape, surface, seen)), extent: extent(mask, seen.wide, seen.high), ...seen };
}
const bent = truth.ticks[furthest];
const desk = await picture(bent);
told.silhouette = desk.same;
// The same test sees that a body is drawn at another tick.
told.silhouetteOfAnotherTick = overlap(unpacked(desk), expected(truth.ticks[nearest], surface, desk));
assert.ok(told.silhouette > 0.98, `the picture is that of the body by ${told.silhouette}`);
assert.ok(told.silhouetteOfAnotherTick < told.silhouette - 0.02, `${told.silhouetteOfAnotherTick}`);

// On a phone the whole body is in the picture, lying and upright.
const inside = ([left, right, low, top]) => left > 0.02 && right < 0.98 && low > 0.02 && top < 0.98;
assert.ok(inside(desk.extent), `the body is at ${desk.extent} of the window`);
for (const [wide, high] of [
  [844, 390],
  [390, 844],
]) {
  await browser.phone(wide, high);
  await until(browser, "a phone's picture", async () => (await browser.value("innerWidth")) === wide);
  await sleep(300);
  const phone = await picture(bent);
  const [left, right, low, top] = phone.extent;
  told[`at ${wide} by ${high}`] = phone.extent.map((x) => x.toFixed(2)).join(" ");
  assert.deepEqual([phone.wide, phone.high], [2 * wide, 2 * high]);
  assert.ok(inside(phone.extent), `the body is at ${phone.extent} of the phone`);
  assert.ok(Math.max((right - left) * wide, (top - low) * high) > 0.4 * Math.min(wide, high), `${phone.extent}`);
  assert.ok(phone.same > 0.98, `the phone's picture is that of the body by ${phone.same}`);
}
await browser.picture(join(OUT, "page-phone.png"));

// One finger turns the view, two zoom, and the page stays where it is.
const away = ({ eye, target }) => Math.hypot(...eye.map((x, axis) => x - target[axis]));
async function touched(from, to) {
  const before = await browser.value("pliant.view()");
  await browser.touch(from, to);
  await sleep(500);
  const page = await browser.value("[scrollX, scrollY, visualViewport.scale, visualViewport.offsetTop]");
  assert.deepEqual(page, [0, 0, 1, 0], "the page itself does not move");
  return [before, await browser.value("pliant.view()")];
}
const [, tapped] = await touched([[200, 500]], [[200, 500]]);
assert.ok(!tapped.touched, "a touch that moves nothing leaves the view to the page");
// Fingers that zoom first, as a wheel does, take the view as well.
const [far, nearer] = await touched([[180, 450], [210, 450]], [[175, 450], [215, 450]]);
assert.ok(nearer.touched && away(nearer) < away(far), `${away(far)} to ${away(nearer)}`);
const [still, turned] = await touched([[200, 500]], [[300, 420]]);
const swung = Math.hypot(...turned.eye.map((x, axis) => x - still.eye[axis])) / away(still);
assert.ok(swung > 0.2 && Math.abs(away(turned) / away(still) - 1) < 0.01, `a finger moves the camera by ${swung}`);
const [, near] = await touched([[180, 450], [210, 450]], [[100, 450], [290, 450]]);
told.pinch = away(near) / away(turned);
assert.ok(near.touched);
assert.ok(told.pinch < 0.7, `two fingers come nearer by ${told.pinch}`);

told.wrong = await browser.value("pliant.numbers.wrong");
assert.equal(told.wrong, 0, await browser.value(line));
assert.ok(told.moved > 0.02, `the body moves by ${told.moved} of its size`);
assert.ok(told.rms < 1e-4 && told.largest < 1e-3, JSON.stringify(told));

/**
 * Waits until frames go on for two seconds without a gap of half a second, and returns when that
 * began, s after the call: what waited in a relay that stood still does not count.
 */
async function goesOn(what) {
  const began = performance.now();
  let [frames, since, last] = [await browser.value("pliant.numbers.frames"), undefined, began];
  await until(browser, what, async () => {
    const [found, now] = [await browser.value("pliant.numbers.frames"), performance.now()];
    if (now - last > 500) since = undefined;
    if (found > frames) {
      since ??= now;
      [frames, last] = [found, now];
    }
    return since !== undefined && now - since > 2000;
  });
  return (since - began) / 1000;
}

// The line is cut for 10 s: the relay stands still.
relay.kill("SIGSTOP");
const cut = performance.now();
// Until Chromium counts the relay as lost, the page says that what is seen is old.
await until(browser, "the age of an old picture", async () => / nothing new for [2-9] s/.test(await browser.value(line)));
told.silence = (performance.now() - cut) / 1000;
await sleep(10_000 - (performance.now() - cut));
relay.kill("SIGCONT");
told.afterCut = await goesOn("frames after a cut line");

relay.kill("SIGKILL");
await sleep(1000);
relay = startRelay();
told.afterRelay = await goesOn("frames after another relay");

host.kill("SIGKILL");
await sleep(1000);
({ host, link } = startHost());
await link;
told.afterHost = await goesOn("frames after another host");
// Whoever has moved the camera keeps it, but for what it still glided.
const kept = await browser.value("pliant.view()");
const glided = Math.hypot(...kept.eye.map((x, axis) => x - near.eye[axis])) / away(near);
assert.ok(glided < 0.2, `the camera is elsewhere by ${glided} of its distance`);

host.kill("SIGTERM");
await until(browser, "the page without a host", async () =>
  (await browser.value(line)).includes("waiting for the host"),
);
assert.ok(asked.host >= 3 && asked.watcher >= 2 && asked.refused === 0, JSON.stringify(asked));

// Whoever has another token does not get in.
await browser.open(address.replace(encodeURIComponent(relayAddress), encodeURIComponent(`${relayAddress}?jwt=no`)));
let frames = 0;
const refusal = async () => {
  frames = Math.max(frames, await browser.value("pliant.numbers.frames"));
  return asked.refused > 0;
};
try {
  await until(browser, "a refusal", refusal);
  await sleep(1000);
  await refusal();
  assert.equal(frames, 0);
} catch (error) {
  // Chromium 156 itself often crashes the tab of a session that its server closes at once: nobody
  // has got in then, either.
  if (!browser.crashed || asked.refused === 0 || frames > 0) throw error;
  console.log("refused; the browser's own fault then ended the tab");
}
console.log("all is well");
process.exit(0);

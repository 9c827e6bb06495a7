// A browser that is driven over a pipe, and a web server for the page.

import { spawn } from "node:child_process";
import { createServer } from "node:http";
import { readFileSync, writeFileSync } from "node:fs";
import { extname, join } from "node:path";

/** How long something is waited for, ms. */
const LONGEST = Number(process.env.LONGEST ?? 60_000);
/** How long an answer of the browser is waited for, ms. */
const ANSWER = 20_000;

export const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

/** What a promise becomes, or an error that says what it was, after a time. */
export function within(ms, what, promise) {
  let timer;
  const late = new Promise((_, failed) => {
    timer = setTimeout(() => failed(new Error(`${what}: not within ${ms / 1000} s`)), ms);
  });
  return Promise.race([promise, late]).finally(() => clearTimeout(timer));
}

/** Ends this program with a failure if it runs for longer: `state` tells where it is. */
export function endAfter(ms, state) {
  setTimeout(async () => {
    console.error(`not at its end after ${ms / 1000} s: ${await within(5000, "its state", state()).catch(String)}`);
    process.exit(1);
  }, ms).unref();
}

const children = new Set();

/** Starts a program that ends with this one. */
export function start(program, ...rest) {
  const child = spawn(program, ...rest);
  children.add(child);
  child.on("exit", () => children.delete(child));
  return child;
}
process.on("exit", () => {
  for (const child of children) child.kill("SIGKILL");
});
for (const signal of ["SIGINT", "SIGTERM"]) process.on(signal, () => process.exit(130));

const kinds = { ".html": "text/html", ".js": "text/javascript", ".txt": "text/plain" };

/** Serves a folder's page, and returns its address. */
export async function serve(site) {
  const web = createServer((request, answer) => {
    const name = request.url === "/" ? "index.html" : request.url.slice(1);
    if (!["index.html", "watch.js", "licenses.txt"].includes(name)) return answer.writeHead(404).end();
    answer.writeHead(200, { "content-type": kinds[extname(name)] }).end(readFileSync(join(site, name)));
  });
  await new Promise((done) => web.listen(0, "127.0.0.1", done));
  return `http://127.0.0.1:${web.address().port}/`;
}

/** Chromium, driven over a pipe: messages of JSON with a zero byte behind each. */
export class Browser {
  #next = 1;
  #waiting = new Map();
  #pending = "";
  #said = [];
  #session;
  /** Whether the process of the page that was opened last has crashed. */
  crashed = false;
  constructor(program, profile) {
    const flags = ["--headless=new", "--no-sandbox", "--no-first-run", "--remote-debugging-pipe"];
    const drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=960,720"];
    const stdio = ["ignore", "ignore", "ignore", "pipe", "pipe"];
    this.child = start(program, [...flags, ...drawing, `--user-data-dir=${profile}`, "about:blank"], { stdio });
    this.child.stdio[4].on("data", (data) => {
      this.#pending += data;
      const parts = this.#pending.split("\0");
      this.#pending = parts.pop();
      for (const part of parts) {
        const { id, result, error, method, params } = JSON.parse(part);
        if (method === "Runtime.consoleAPICalled" || method === "Runtime.exceptionThrown") {
          this.#said.push(JSON.stringify(params.args?.map((one) => one.value ?? one.description) ?? params));
          if (this.#said.length > 40) this.#said.shift();
        }
        if (method === "Inspector.targetCrashed") {
          this.crashed = true;
          this.#failAll("the page's process crashed");
        }
        const waiting = this.#waiting.get(id);
        this.#waiting.delete(id);
        if (error) waiting?.[1](new Error(error.message));
        else waiting?.[0](result);
      }
    });
    this.child.on("exit", (code, signal) => this.#failAll(`the browser ended: ${code ?? signal}`));
    // A pipe to a browser that has ended is no reason to end without a word.
    this.child.stdio[3].on("error", () => {});
  }
  // Who has crashed answers nothing, and says so once.
  #failAll(why) {
    for (const [, failed] of this.#waiting.values()) failed(new Error(why));
    this.#waiting.clear();
  }
  /** A command and its answer, which is waited for `ms` at most. */
  send(method, params = {}, sessionId = this.#session, ms = ANSWER) {
    const id = this.#next++;
    const answer = new Promise((...both) => this.#waiting.set(id, both));
    this.child.stdio[3].write(`${JSON.stringify({ id, method, params, ...(sessionId && { sessionId }) })}\0`);
    const about = `${method} ${(params.expression ?? params.url ?? "").slice(0, 80)}`.trim();
    return within(ms, `the browser's answer to ${about}`, answer).finally(() => this.#waiting.delete(id));
  }
  /** Opens a page in a tab of its own; `first` runs before its scripts. */
  async open(url, first) {
    const { targetId } = await this.send("Target.createTarget", { url: "about:blank" }, null);
    const attached = await this.send("Target.attachToTarget", { targetId, flatten: true }, null);
    this.#session = attached.sessionId;
    this.crashed = false;
    await this.send("Inspector.enable");
    await this.send("Page.enable");
    await this.send("Runtime.enable");
    if (first) await this.send("Page.addScriptToEvaluateOnNewDocument", { source: first });
    await this.send("Page.navigate", { url });
  }
  /** The value of an expression in the page. */
  async value(expression) {
    if (this.crashed) throw new Error("the page's process crashed");
    const options = { expression, returnByValue: true, awaitPromise: true };
    const { result, exceptionDetails } = await this.send("Runtime.evaluate", options);
    if (exceptionDetails) throw new Error(`${expression.slice(0, 80)}: ${JSON.stringify(exceptionDetails)}`);
    return result.value;
  }
  /** What the page says, and what it said to its console. */
  async state() {
    const expression = "`${document.body.innerText}\\n${window.pliant?.wrongs().join()}\\n${JSON.stringify(window.pliant?.numbers)}`";
    const text = await within(3000, "the page's answer", this.value(expression)).catch((error) => `${error}`);
    return `${text}\n${this.#said.join("\n")}`;
  }
  /** Makes the page's screen that of a phone. */
  async phone(width, height) {
    await this.send("Emulation.setTouchEmulationEnabled", { enabled: true, maxTouchPoints: 2 });
    const metrics = { width, height, deviceScaleFactor: 2, mobile: true };
    await this.send("Emulation.setDeviceMetricsOverride", metrics);
  }
  /** Fingers that go from places to places, each an array of x and y. */
  async touch(from, to, steps = 12) {
    const points = (part) =>
      from.map(([x, y], k) => ({ x: x + (to[k][0] - x) * part, y: y + (to[k][1] - y) * part, id: k }));
    await this.send("Input.dispatchTouchEvent", { type: "touchStart", touchPoints: points(0) });
    for (let step = 1; step <= steps; step++) {
      await this.send("Input.dispatchTouchEvent", { type: "touchMove", touchPoints: points(step / steps) });
      await sleep(16);
    }
    await this.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
  }
  async picture(file) {
    const { data } = await this.send("Page.captureScreenshot", { format: "png" });
    writeFileSync(file, Buffer.from(data, "base64"));
  }
}

/** Waits until something is so, and returns how long that took, s. */
export async function until(browser, what, so) {
  const began = performance.now();
  let last = "";
  while (performance.now() - began < LONGEST && !browser.crashed) {
    try {
      if (await so()) return (performance.now() - began) / 1000;
      last = "";
    } catch (error) {
      last = `${error.message}\n`;
    }
    await sleep(20);
  }
  const passed = ((performance.now() - began) / 1000).toFixed(0);
  throw new Error(`${what}: not after ${passed} s: ${last}${await browser.state()}`);
}

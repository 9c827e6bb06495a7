// A browser that is driven over a pipe, and a web server for the page.

import { spawn } from "node:child_process";
import { createServer } from "node:http";
import { readFileSync, writeFileSync } from "node:fs";
import { extname, join } from "node:path";

const LONGEST = Number(process.env.LONGEST ?? 60_000);

export const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

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
        const waiting = this.#waiting.get(id);
        this.#waiting.delete(id);
        if (error) waiting?.[1](new Error(error.message));
        else waiting?.[0](result);
      }
    });
  }
  send(method, params = {}, sessionId = this.#session) {
    const id = this.#next++;
    const answer = new Promise((...both) => this.#waiting.set(id, both));
    this.child.stdio[3].write(`${JSON.stringify({ id, method, params, ...(sessionId && { sessionId }) })}\0`);
    return answer;
  }
  async open(url) {
    const { targetId } = await this.send("Target.createTarget", { url: "about:blank" }, null);
    const attached = await this.send("Target.attachToTarget", { targetId, flatten: true }, null);
    this.#session = attached.sessionId;
    await this.send("Page.enable");
    await this.send("Runtime.enable");
    await this.send("Page.navigate", { url });
  }
  /** The value of an expression in the page. */
  async value(expression) {
    const options = { expression, returnByValue: true, awaitPromise: true };
    const { result, exceptionDetails } = await this.send("Runtime.evaluate", options);
    if (exceptionDetails) throw new Error(`${expression.slice(0, 80)}: ${JSON.stringify(exceptionDetails)}`);
    return result.value;
  }
  /** What the page says, and what it said to its console. */
  async state() {
    const text = await this.value("`${document.body.innerText}\\n${pliant.wrongs().join()}`").catch((error) => `${error}`);
    return `${text}\n${this.#said.join("\n")}`;
  }
  async picture(file) {
    const { data } = await this.send("Page.captureScreenshot", { format: "png" });
    writeFileSync(file, Buffer.from(data, "base64"));
  }
}

/** Waits until something is so, and returns how long that took, s. */
export async function until(browser, what, so) {
  const began = performance.now();
  while (performance.now() - began < LONGEST) {
    // A browser that does not answer is no answer.
    const late = sleep(LONGEST).then(() => false);
    if (await Promise.race([so().catch(() => false), late])) return (performance.now() - began) / 1000;
    await sleep(20);
  }
  const state = await Promise.race([browser.state(), sleep(3000).then(() => "the page does not answer")]);
  throw new Error(`${what}: not after ${LONGEST / 1000} s: ${state}`);
}


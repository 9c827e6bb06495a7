// Decodes what the encoders of pliant_stream write, bit for bit, and takes any damage. The file
// vectors.json is written and checked by crates/pliant_cli/tests/page.rs.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import {
  Assembler,
  BodyDecoder,
  MAX_GROUP_FRAMES,
  WrongData,
  readCatalog,
  readHands,
  readSurface,
  shapeOf,
} from "../node_modules/.watch-test/format.mjs";

const vectors = JSON.parse(readFileSync(new URL("vectors.json", import.meta.url), "utf8"));
const bytes = (hex) => Uint8Array.from(Buffer.from(hex, "hex"));

test("the catalog is read as it was written", () => {
  const { bytes: hex, session, ...expected } = vectors.catalog;
  const { session: found, ...catalog } = readCatalog(bytes(hex));
  assert.equal(found, BigInt(session));
  assert.deepStrictEqual(catalog, expected);
});

test("hands are read as they were written", () => {
  const { bytes: hex, ...expected } = vectors.hands;
  assert.deepStrictEqual(readHands(bytes(hex)), expected);
});

test("a surface is drawn as pliant_stream draws it", () => {
  const { bytes: hex, model, places, q, straight, warped } = vectors.surface;
  const surface = readSurface(bytes(hex));
  assert.equal(surface.model, model);
  assert.deepStrictEqual([...surface.places], places);
  for (const [warps, expected] of [
    [false, straight],
    [true, warped],
  ]) {
    const shape = shapeOf(surface, Float64Array.from(q), warps);
    assert.equal(shape.length, expected.flat().length);
    // Rows are single precision in the page.
    expected.flat().forEach((x, k) => assert.ok(Math.abs(shape[k] - x) < 1e-6, `${shape[k]} for ${x}`));
  }
  const apart = straight.flat().map((x, k) => Math.abs(x - warped.flat()[k]));
  assert.ok(Math.max(...apart) > 0.01, "the warp is seen");
});

test("frames give the same numbers, bit for bit", () => {
  let frames = 0;
  for (const course of vectors.courses) {
    const decoder = new BodyDecoder(Float32Array.from(course.places));
    for (const frame of course.frames) {
      const state = decoder.decode(bytes(frame.bytes));
      assert.equal(state.tick, frame.tick);
      assert.equal(state.resting, frame.resting);
      assert.deepStrictEqual([...state.q], frame.q);
      assert.deepStrictEqual(state.position, frame.position);
      assert.deepStrictEqual(state.rotation, frame.rotation);
      frames++;
    }
  }
  assert.ok(frames > 100);
});

// The generator of the Rust tests' kind: the same damage in each run.
let seed = 1n;
const random = (below) => {
  seed = (seed * 6364136223846793005n + 1442695040888963407n) & 0xffffffffffffffffn;
  return Number((seed >> 33n) % BigInt(below));
};

function damaged(whole) {
  const kind = random(4);
  if (kind === 0) return whole.slice(0, random(whole.length + 1));
  if (kind === 1) return Uint8Array.from({ length: random(200) }, () => random(256));
  const out = Uint8Array.from([...whole, ...(kind === 2 ? Array.from({ length: random(9) }, () => random(256)) : [])]);
  for (let k = random(4); k >= 0; k--) if (out.length > 0) out[random(out.length)] = random(256);
  return out;
}

/** Only this error may come out of a parser. Returns whether it did. */
function refused(read) {
  try {
    read();
    return false;
  } catch (error) {
    if (!(error instanceof WrongData)) throw error;
    return true;
  }
}

test("damaged bytes are refused or read, and nothing else happens", () => {
  const parsers = [
    [readCatalog, bytes(vectors.catalog.bytes)],
    [readHands, bytes(vectors.hands.bytes)],
    [readSurface, bytes(vectors.surface.bytes)],
  ];
  let [wrong, all] = [0, 0];
  for (const [read, whole] of parsers) {
    for (let k = 0; k < whole.length; k++) assert.ok(refused(() => read(whole.slice(0, k))), "what is cut off");
    assert.ok(refused(() => read(Uint8Array.from([...whole, 0]))), "what is too long");
    for (let k = 0; k < 20000; k++, all++) if (refused(() => read(damaged(whole)))) wrong++;
  }
  for (const course of vectors.courses) {
    const decoder = new BodyDecoder(Float32Array.from(course.places));
    for (let k = 0; k < 40000; k++, all++) {
      const whole = bytes(course.frames[random(course.frames.length)].bytes);
      const given = random(3) === 0 ? whole : damaged(whole);
      const bad = refused(() => {
        const state = decoder.decode(given);
        assert.ok(state.q.every(Number.isFinite) && state.q.length <= course.places.length);
        assert.ok(state.tick >= 0 && state.tick < 2 ** 48);
      });
      if (bad) wrong++;
    }
    // After all of it a whole group is read as ever.
    const state = decoder.decode(bytes(course.frames[0].bytes));
    assert.deepStrictEqual([...state.q], course.frames[0].q);
  }
  assert.ok(wrong > all / 3 && wrong < all, `${wrong} of ${all}`);
});

test("a surface of huge counts takes no memory", () => {
  const huge = bytes(vectors.surface.bytes);
  new DataView(huge.buffer).setUint32(8, 0xffffffff, true);
  new DataView(huge.buffer).setUint32(12, 0xffffffff, true);
  assert.ok(refused(() => readSurface(huge)));
  assert.ok(refused(() => new Assembler(2 ** 40)));
  const assembler = new Assembler(10);
  assert.equal(assembler.push(new Uint8Array(6)), undefined);
  assert.ok(refused(() => assembler.push(new Uint8Array(5))));
  assert.ok(refused(() => assembler.push(new Uint8Array(0))));
  assert.equal(assembler.push(new Uint8Array(4)).length, 10);
});

test("a group without end is refused, and the next one is read", () => {
  const decoder = new BodyDecoder(Float32Array.from(vectors.courses[0].places));
  // A snapshot of no coordinates at tick 1 in units of 1 m, and frames a tick on.
  const snapshot = Uint8Array.from([1, 1, 0, 0, 0, 0, 0, 0, 0, 128, 63, 0, 0]);
  decoder.decode(snapshot);
  for (let frame = 1; frame < MAX_GROUP_FRAMES; frame++) {
    assert.equal(decoder.decode(Uint8Array.of(4)).tick, 1 + frame);
  }
  assert.ok(refused(() => decoder.decode(Uint8Array.of(4))));
  assert.ok(refused(() => decoder.decode(Uint8Array.of(4))), "the group is over");
  assert.equal(decoder.decode(snapshot).tick, 1);
});

// From where the page looks: bodies are in the picture of any screen, and the camera is the
// watcher's once they have moved it.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Box3, Vector3 } from "three";
import { Drawn, Eye, Model } from "../node_modules/.watch-test/scene.mjs";

/** The corners of a box, as shares of the picture from its middle to its edge. */
function seen(eye, bounds) {
  eye.camera.updateMatrixWorld();
  let [across, up] = [0, 0];
  for (let k = 0; k < 8; k++) {
    const corner = new Vector3(...["x", "y", "z"].map((axis, bit) => (k & (1 << bit) ? bounds.max : bounds.min)[axis]));
    const { x, y, z } = corner.project(eye.camera);
    assert.ok(z > -1 && z < 1, "between the nearest and the farthest");
    [across, up] = [Math.max(across, Math.abs(x)), Math.max(up, Math.abs(y))];
  }
  return [across, up];
}

const boxes = [
  ["a cube", new Box3(new Vector3(-1, -1, -1), new Vector3(1, 1, 1))],
  ["a bar", new Box3(new Vector3(5, 0, 0), new Vector3(6, 0.1, 0.1))],
  ["a tower", new Box3(new Vector3(0, 0, 0), new Vector3(1e-3, 0.02, 1e-3))],
];
const screens = [
  [390, 844],
  [844, 390],
  [1280, 720],
  [700, 700],
];

test("all bodies are in the picture of any screen, and large enough", () => {
  for (const [name, bounds] of boxes) {
    for (const [wide, high] of screens) {
      // A phone may be turned after the view was chosen, or before.
      for (const earlier of [true, false]) {
        const eye = new Eye();
        if (earlier) eye.resize(wide, high);
        eye.frame(bounds, undefined);
        eye.resize(wide, high);
        const [across, up] = seen(eye, bounds);
        const where = `${name} at ${wide} by ${high}: ${across} by ${up}`;
        assert.ok(across < 0.95 && up < 0.95, where);
        assert.ok(Math.max(across * Math.max(1, wide / high), up * Math.max(1, high / wide)) > 0.5, where);
      }
    }
  }
});

test("a camera of the host has its angle in the smaller direction", () => {
  const eye = new Eye();
  const view = { eye: [0, 0, 2], at: [0, 0, 0], fieldOfView: 1 };
  eye.resize(1280, 720);
  eye.frame(boxes[0][1], view);
  assert.deepEqual(eye.camera.position.toArray(), [0, 0, 2]);
  assert.ok(Math.abs((eye.camera.fov * Math.PI) / 180 - 1) < 1e-9);
  eye.resize(390, 844);
  const across = 2 * Math.atan((Math.tan((eye.camera.fov * Math.PI) / 360) * 390) / 844);
  assert.ok(Math.abs(across - 1) < 1e-9);
});

test("the camera stays where somebody has moved it", () => {
  const eye = new Eye();
  eye.resize(390, 844);
  eye.frame(boxes[0][1], undefined);
  eye.camera.position.set(7, 7, 7);
  eye.touched = true;
  eye.frame(boxes[1][1], { eye: [0, 0, 2], at: [0, 0, 0], fieldOfView: 1 });
  assert.deepEqual(eye.camera.position.toArray(), [7, 7, 7]);
  const smaller = 2 * Math.atan((Math.tan((eye.camera.fov * Math.PI) / 360) * 390) / 844);
  assert.ok(Math.abs(smaller - Math.PI / 4) < 1e-9, "its angle stays, too");
});

test("a free body stays at its pose when its size or color changes", () => {
  const [numbers, none] = [Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0), new Float32Array(9)];
  const triangle = { positions: numbers, triangles: Uint32Array.of(0, 1, 2) };
  const surface = { model: "", modes: 1, places: Float32Array.of(1), ...triangle, displacement: none, rotation: none };
  const body = { free: true, warps: false, position: [0, 0, 0], orientation: [0, 0, 0, 1], scale: 1, color: [9, 9, 9, 255] };
  const drawn = new Drawn(body, new Model(surface, 64));
  const state = { tick: 1, q: Float64Array.of(0), position: [1, 2, 3], rotation: [0, 1, 0, 0], resting: true };
  drawn.show(state, state, 0);
  drawn.place({ ...body, scale: 2 });
  assert.deepEqual(drawn.mesh.position.toArray(), [2, 4, 6]);
  assert.deepEqual(drawn.mesh.quaternion.toArray(), [0, 1, 0, 0]);
  assert.equal(drawn.mesh.scale.x, 2);
});

test("an anchored body that is moved is where its frames say", () => {
  const [numbers, none] = [Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0), new Float32Array(9)];
  const triangle = { positions: numbers, triangles: Uint32Array.of(0, 1, 2) };
  const surface = { model: "", modes: 1, places: Float32Array.of(1), ...triangle, displacement: none, rotation: none };
  const body = { free: false, warps: false, position: [7, 0, 0], orientation: [0, 0, 0, 1], scale: 2, color: [9, 9, 9, 255] };
  const drawn = new Drawn(body, new Model(surface, 64));
  const rests = { tick: 1, q: Float64Array.of(0), resting: false };
  drawn.show(rests, rests, 0);
  assert.deepEqual(drawn.mesh.position.toArray(), [7, 0, 0]);
  const [from, to] = [4, 6].map((x) => ({ ...rests, position: [x, 0, 0], rotation: [0, 0, 0, 1] }));
  drawn.show(from, to, 0.5);
  assert.deepEqual(drawn.mesh.position.toArray(), [10, 0, 0]);
});

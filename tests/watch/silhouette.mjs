// What must be seen of a surface from a camera, and how far a picture is from it. Nothing of the
// page's own drawing is used: no matrices of its library, and no shader.

/** Where a quaternion (x, y, z, w) turns a vector. */
function turn([x, y, z, w], [a, b, c]) {
  const [i, j, k] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i];
}

/** Which pixels have a surface whose vertices are at `shape`, rows from below. */
export function expected(shape, { triangles, position, orientation, scale }, view) {
  const { wide, high, eye, turned, fieldOfView } = view;
  const mask = new Uint8Array(wide * high);
  const back = [-turned[0], -turned[1], -turned[2], turned[3]];
  const near = high / 2 / Math.tan(fieldOfView / 2);
  const pixel = [];
  for (let at = 0; at < shape.length; at += 3) {
    const world = turn(orientation, [0, 1, 2].map((axis) => scale * shape[at + axis]));
    const [x, y, z] = turn(back, world.map((w, axis) => w + position[axis] - eye[axis]));
    pixel.push([wide / 2 - (near * x) / z, high / 2 - (near * y) / z]);
  }
  for (let at = 0; at < triangles.length; at += 3) {
    const corners = [0, 1, 2].map((k) => pixel[triangles[at + k]]);
    const [[ax, ay], [bx, by], [cx, cy]] = corners;
    const from = (axis) => Math.max(0, Math.floor(Math.min(...corners.map((corner) => corner[axis]))));
    const to = (axis, most) => Math.min(most - 1, Math.ceil(Math.max(...corners.map((corner) => corner[axis]))));
    const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if (area === 0) continue;
    for (let row = from(1); row <= to(1, high); row++) {
      for (let column = from(0); column <= to(0, wide); column++) {
        const [x, y] = [column + 0.5, row + 0.5];
        const a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area;
        const b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area;
        if (a >= 0 && b >= 0 && a + b <= 1) mask[row * wide + column] = 1;
      }
    }
  }
  return mask;
}

/** The pixels of runs, as `pliant.drawn` has them. */
export function unpacked({ wide, high, runs }) {
  const mask = new Uint8Array(wide * high);
  let at = 0;
  runs.forEach((length, k) => {
    mask.fill(k % 2, at, at + length);
    at += length;
  });
  return mask;
}

/** Pixels that both have, as a share of those that either has. */
export function overlap(a, b) {
  let [both, either] = [0, 0];
  for (let at = 0; at < a.length; at++) {
    both += a[at] & b[at];
    either += a[at] | b[at];
  }
  return both / Math.max(1, either);
}

/** The rectangle of what is seen, as shares of the picture: left, right, lower and upper edge. */
export function extent(mask, wide, high) {
  let [left, right, low, top] = [wide, 0, high, 0];
  mask.forEach((on, at) => {
    if (!on) return;
    const [x, y] = [at % wide, Math.floor(at / wide)];
    [left, right, low, top] = [Math.min(left, x), Math.max(right, x + 1), Math.min(low, y), Math.max(top, y + 1)];
  });
  return [left / wide, right / wide, low / high, top / high];
}

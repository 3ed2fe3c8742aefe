// Shadow rays on the CPU: a tree of boxes, split where the surface area heuristic is lowest over a few bins.

const LEAF = 4;
const BINS = 12;
const EDGE = 1e-12; // what rounding may take from a triangle: no ray slips through between two

export class Bvh {
  /**
   * corners: nine numbers a triangle.
   * open: (triangle, u, v) => whether there is a hole; null where nothing has holes.
   */
  constructor(corners, open = null) {
    const count = corners.length / 9;
    this.corners = corners;
    this.open = open;
    this.order = Int32Array.from({ length: count }, (_, i) => i);
    this.low = [];
    this.high = [];
    this.first = []; // of a leaf's triangles, or the right child of a node; the left one comes right after it
    this.count = []; // 0 for what is no leaf
    this.#boxes();
    if (count > 0) this.#build(0, count);
  }

  #boxes() {
    const n = this.order.length;
    this.boxes = new Float64Array(6 * n);
    for (let t = 0; t < n; t++)
      for (let axis = 0; axis < 3; axis++) {
        const a = this.corners[9 * t + axis];
        const b = this.corners[9 * t + 3 + axis];
        const c = this.corners[9 * t + 6 + axis];
        this.boxes[6 * t + axis] = Math.min(a, b, c);
        this.boxes[6 * t + 3 + axis] = Math.max(a, b, c);
      }
  }

  #around(start, stop) {
    const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
    for (let i = start; i < stop; i++) grow(box, this.boxes, 6 * this.order[i]);
    return box;
  }

  #build(start, stop) {
    const node = this.count.length;
    const box = this.#around(start, stop);
    this.low.push(box.slice(0, 3));
    this.high.push(box.slice(3));
    this.first.push(start);
    this.count.push(stop - start);
    if (stop - start <= LEAF) return;
    const middle = this.#split(start, stop);
    this.count[node] = 0;
    this.#build(start, middle);
    this.first[node] = this.count.length;
    this.#build(middle, stop);
  }

  #middle(t, axis) {
    return this.boxes[6 * t + axis] + this.boxes[6 * t + 3 + axis];
  }

  #split(start, stop) {
    let best = { cost: Infinity };
    for (let axis = 0; axis < 3; axis++) {
      let low = Infinity;
      let high = -Infinity;
      for (let i = start; i < stop; i++) {
        const middle = this.#middle(this.order[i], axis);
        low = Math.min(low, middle);
        high = Math.max(high, middle);
      }
      if (!(high > low)) continue;
      const bin = (t) => Math.min(BINS - 1, Math.floor((BINS * (this.#middle(t, axis) - low)) / (high - low)));
      const sizes = new Int32Array(BINS);
      const boxes = Array.from({ length: BINS }, () => [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity]);
      for (let i = start; i < stop; i++) {
        const place = bin(this.order[i]);
        sizes[place]++;
        grow(boxes[place], this.boxes, 6 * this.order[i]);
      }
      for (let cut = 1; cut < BINS; cut++) {
        const cost = weight(sizes, boxes, 0, cut) + weight(sizes, boxes, cut, BINS);
        if (cost < best.cost) best = { cost, cut, bin };
      }
    }
    if (best.cost === Infinity) return (start + stop) >> 1; // all in one place
    const part = Array.from(this.order.subarray(start, stop));
    const left = part.filter((t) => best.bin(t) < best.cut);
    this.order.set([...left, ...part.filter((t) => best.bin(t) >= best.cut)], start);
    return start + left.length;
  }

  /** Whether anything lies on a ray within `reach`; the direction has unit length. */
  occluded(ox, oy, oz, dx, dy, dz, reach) {
    if (this.count.length === 0) return false;
    const o = [ox, oy, oz];
    const d = [dx, dy, dz];
    const stack = [0];
    while (stack.length > 0) {
      const node = stack.pop();
      if (!meets(this.low[node], this.high[node], o, d, reach)) continue;
      const count = this.count[node];
      if (count === 0) {
        stack.push(this.first[node], node + 1);
        continue;
      }
      for (let i = this.first[node]; i < this.first[node] + count; i++) if (this.#hit(this.order[i], o, d, reach)) return true;
    }
    return false;
  }

  // Moeller and Trumbore 1997.
  #hit(t, o, d, reach) {
    const c = this.corners;
    const at = 9 * t;
    const ax = c[at];
    const ay = c[at + 1];
    const az = c[at + 2];
    const bx = c[at + 3] - ax;
    const by = c[at + 4] - ay;
    const bz = c[at + 5] - az;
    const cx = c[at + 6] - ax;
    const cy = c[at + 7] - ay;
    const cz = c[at + 8] - az;
    const px = d[1] * cz - d[2] * cy;
    const py = d[2] * cx - d[0] * cz;
    const pz = d[0] * cy - d[1] * cx;
    const det = bx * px + by * py + bz * pz;
    if (det === 0) return false;
    const sx = o[0] - ax;
    const sy = o[1] - ay;
    const sz = o[2] - az;
    const u = (sx * px + sy * py + sz * pz) / det;
    if (u < -EDGE || u > 1 + EDGE) return false;
    const qx = sy * bz - sz * by;
    const qy = sz * bx - sx * bz;
    const qz = sx * by - sy * bx;
    const v = (d[0] * qx + d[1] * qy + d[2] * qz) / det;
    if (v < -EDGE || u + v > 1 + EDGE) return false;
    const distance = (cx * qx + cy * qy + cz * qz) / det;
    if (!(distance > 0 && distance < reach)) return false;
    return this.open === null || !this.open(t, u, v);
  }
}

function grow(box, boxes, at) {
  for (let axis = 0; axis < 3; axis++) {
    box[axis] = Math.min(box[axis], boxes[at + axis]);
    box[3 + axis] = Math.max(box[3 + axis], boxes[at + 3 + axis]);
  }
}

function weight(sizes, boxes, from, to) {
  const whole = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
  let count = 0;
  for (let i = from; i < to; i++) {
    if (sizes[i] === 0) continue;
    count += sizes[i];
    grow(whole, boxes[i], 0);
  }
  if (count === 0) return Infinity;
  const [x, y, z] = [0, 1, 2].map((axis) => whole[3 + axis] - whole[axis]);
  return count * (x * y + y * z + z * x);
}

function meets(low, high, o, d, reach) {
  let near = 0;
  let far = reach;
  for (let axis = 0; axis < 3; axis++) {
    if (d[axis] === 0) {
      if (o[axis] < low[axis] || o[axis] > high[axis]) return false;
      continue;
    }
    const a = (low[axis] - o[axis]) / d[axis];
    const b = (high[axis] - o[axis]) / d[axis];
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far * (1 + 1e-9) + 1e-12;
}

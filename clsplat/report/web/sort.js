// A worker that orders the gaussians from back to front, by a counting sort of their depths, and
// finds the surface that a ray meets. `ranges` says which gaussians count: [first, from, count],
// those of the part that begins at the gaussian `first` of the tables, from one of its own on.
"use strict";

const BUCKETS = 1 << 17;
const FAINTEST = 1 / 255, REACH = Math.sqrt(2 * Math.log(255)); // of alpha; standard deviations
const parts = new Map(), starts = new Uint32Array(BUCKETS);
let depths = new Float32Array(0), keys, tables, ranges = [];

// Depths along the forward axis; floats above zero order as their bits, so the difference of two
// keys is that of the logarithms of the depths, nearly.
function sorted({ forward: [x, y, z], position, near }) {
  const offset = x * position[0] + y * position[1] + z * position[2];
  const total = ranges.reduce((sum, [, , count]) => sum + count, 0);
  if (depths.length < total) keys = new Uint32Array((depths = new Float32Array(total)).buffer);
  let drawn = 0, least = 0xffffffff, most = 0, at = 0;
  for (const [first, from, count] of ranges) {
    const { positions } = parts.get(first);
    for (let i = 4 * from, end = 4 * (from + count); i < end; i += 4, at++) {
      const depth = x * positions[i] + y * positions[i + 1] + z * positions[i + 2] - offset;
      depths[at] = depth;
      if (depth > near) {
        drawn++;
        if (keys[at] < least) least = keys[at];
        if (keys[at] > most) most = keys[at];
      }
    }
  }
  const scale = (BUCKETS - 1) / Math.max(1, most - least);
  starts.fill(0);
  for (let i = 0; i < total; i++)
    if (depths[i] > near) starts[((most - keys[i]) * scale) | 0]++;
  for (let bucket = 0, sum = 0; bucket < BUCKETS; bucket++) {
    const here = starts[bucket];
    starts[bucket] = sum;
    sum += here;
  }
  const order = new Uint32Array(drawn);
  at = 0;
  for (const [first, from, count] of ranges)
    for (let i = first + from, end = i + count; i < end; i++, at++)
      if (depths[at] > near) order[starts[((most - keys[at]) * scale) | 0]++] = i;
  return order;
}

// How far away along a ray, a unit vector, the first half of the light ends; undefined if less of
// it ends at all. A pixel has this size at a distance of one, and no gaussian is thinner.
function surface({ position: [px, py, pz], ray: [rx, ry, rz], near, pixel, cut }) {
  const hits = [], [red, green, blue] = tables;
  for (const [first, from, count] of ranges) {
    const { positions, opacities, shapes } = parts.get(first);
    for (let i = from; i < from + count; i++) {
      const dx = positions[4 * i] - px, dy = positions[4 * i + 1] - py;
      const dz = positions[4 * i + 2] - pz, along = dx * rx + dy * ry + dz * rz;
      if (along <= near) continue;
      const thin = pixel * along, word = shapes[2 * i];
      const s = [red[word & 255], green[word >>> 8 & 255], blue[word >>> 16 & 255]];
      const far = REACH * (Math.max(s[0], s[1], s[2]) + thin);
      if (dx * dx + dy * dy + dz * dz - along * along > far * far) continue;
      if (cut && cut.axes.some((axis, k) => {
        const at = axis[0] * (dx + px) + axis[1] * (dy + py) + axis[2] * (dz + pz);
        return at < cut.low[k] || at > cut.high[k];
      })) continue;
      let aa = 0, ab = 0, bb = 0; // of the centre and the ray, in standard deviations
      turned(shapes[2 * i + 1]).forEach((axis, k) => {
        const size = Math.hypot(s[k], thin);
        const a = (axis[0] * dx + axis[1] * dy + axis[2] * dz) / size;
        const b = (axis[0] * rx + axis[1] * ry + axis[2] * rz) / size;
        aa += a * a;
        ab += a * b;
        bb += b * b;
      });
      const alpha = opacities[16 * i + 15] / 255 * Math.exp(-0.5 * (aa - ab * ab / bb));
      if (alpha > FAINTEST) hits.push([ab / bb, Math.min(0.99, alpha)]);
    }
  }
  hits.sort((a, b) => a[0] - b[0]);
  let left = 1;
  for (const [along, alpha] of hits) if ((left *= 1 - alpha) < 0.5) return along;
  return undefined;
}

// The axes of a gaussian, as web/splat.vert has them.
function turned(word) {
  const others = [word & 1023, word >>> 10 & 1023, word >>> 20 & 1023].map(
    (steps) => (steps / 1023 - 0.5) * Math.SQRT2);
  others.splice(word >>> 30, 0, Math.sqrt(Math.max(0, 1 - others.reduce((s, v) => s + v * v, 0))));
  const [w, x, y, z] = others;
  return [[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
          [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
          [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]];
}

onmessage = ({ data }) => {
  if (data.logScales) {
    const [low, size] = data.logScales;
    tables = low.map((value, k) => Float32Array.from(
      { length: 256 }, (_, byte) => Math.exp(value + size[k] * byte / 255)));
  } else if (data.places) {
    parts.set(data.first, { positions: new Float32Array(data.places.buffer), shapes: data.shapes,
                            opacities: new Uint8Array(data.places.buffer) });
  } else if (data.ray) {
    postMessage({ asked: data.asked, along: surface(data) });
  } else {
    ({ ranges } = data);
    const order = sorted(data);
    postMessage({ order }, [order.buffer]);
  }
};

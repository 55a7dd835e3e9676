// A worker that orders the gaussians from back to front, by a counting sort of their depths, and
// finds the surface that a ray meets. `ranges` says which gaussians count: [first, from, count],
// those of the part that begins at the gaussian `first` of the tables, from one of its own on.
"use strict";

const BUCKETS = 1 << 17;
const FAINTEST = 1 / 255, REACH = Math.sqrt(2 * Math.log(255)); // of alpha; standard deviations
const LOW_PASS = 0.3; // as web/splat.vert
const HAZE = 0.05; // share of a distance by which a surface may differ from its gaussian's middle
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
// it ends at all. Alphas and order are those of the picture (web/splat.vert) at a place x, y of it,
// through which the ray goes; the gaussian that is met tells the distance.
function surface({ camera: { position, rotation, focal, centre, ratios }, x, y, ray, near, cut }) {
  const hits = [], [red, green, blue] = tables, [right, down, ahead] = rotation;
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  for (const [first, from, count] of ranges) {
    const { positions, opacities, shapes } = parts.get(first);
    for (let i = from; i < from + count; i++) {
      const dx = positions[4 * i] - position[0], dy = positions[4 * i + 1] - position[1];
      const dz = positions[4 * i + 2] - position[2];
      const z = dx * ahead[0] + dy * ahead[1] + dz * ahead[2];
      if (z <= near) continue;
      const px = (dx * right[0] + dy * right[1] + dz * right[2]) / z;
      const py = (dx * down[0] + dy * down[1] + dz * down[2]) / z;
      const u = focal[0] * px + centre[0] - x, v = focal[1] * py + centre[1] - y;
      const word = shapes[2 * i], fx = focal[0] / z, fy = focal[1] / z;
      const s = [red[word & 255], green[word >>> 8 & 255], blue[word >>> 16 & 255]];
      const rx = Math.min(ratios[2], Math.max(ratios[0], px));
      const ry = Math.min(ratios[3], Math.max(ratios[1], py));
      const widest = Math.max(fx, fy) * Math.sqrt(1 + rx * rx + ry * ry);
      const far = REACH * (Math.max(s[0], s[1], s[2]) * 1.5 * widest + 1);
      if (u * u + v * v > far * far) continue;
      const away = [dx, dy, dz], axes = turned(shapes[2 * i + 1]);
      if (cut && cut.axes.some((axis, k) => {
        const at = dot(axis, away) + dot(axis, position);
        return at < cut.low[k] || at > cut.high[k];
      })) continue;
      let a = LOW_PASS, b = 0, c = LOW_PASS;
      axes.forEach((axis, k) => {
        const m1 = s[k] * fx * (dot(axis, right) - rx * dot(axis, ahead));
        const m2 = s[k] * fy * (dot(axis, down) - ry * dot(axis, ahead));
        a += m1 * m1;
        b += m1 * m2;
        c += m2 * m2;
      });
      const distance = (c * u * u - 2 * b * u * v + a * v * v) / (a * c - b * b);
      const alpha = Math.min(0.99, opacities[16 * i + 15] / 255 * Math.exp(-0.5 * distance));
      if (alpha > FAINTEST) hits.push({ z, alpha, away, axes, sizes: s.map(
        (size) => Math.hypot(size, 1 / fx)) }); // no thinner than a pixel
    }
  }
  hits.sort((one, other) => one.z - other.z);
  let left = 1;
  const met = hits.find(({ alpha }) => (left *= 1 - alpha) < 0.5);
  if (!met) return undefined;
  let across = 0, along = 0; // where the ray is nearest to its centre, in standard deviations
  met.axes.forEach((axis, k) => {
    const step = dot(axis, ray) / met.sizes[k];
    across += step * dot(axis, met.away) / met.sizes[k];
    along += step * step;
  });
  // a gaussian so large that its middle is elsewhere is haze, and no surface
  const middle = met.z / dot(ray, ahead), least = middle * (1 - HAZE);
  return Math.min(middle * (1 + HAZE), Math.max(least, across / along));
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

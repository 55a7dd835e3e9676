// A worker that orders the gaussians from back to front: a counting sort by depth.
"use strict";

const BUCKETS = 1 << 17;
let positions, opacities, sizes, depths, keys, starts;

// Depths along the forward axis; floats above zero order as their bits, so the difference of two
// keys is that of the logarithms of the depths, nearly.
function sorted({ forward: [x, y, z], position, near }) {
  const count = depths.length, offset = x * position[0] + y * position[1] + z * position[2];
  let drawn = 0, least = 0xffffffff, most = 0;
  for (let i = 0; i < count; i++) {
    const depth = x * positions[3 * i] + y * positions[3 * i + 1] + z * positions[3 * i + 2]
      - offset;
    depths[i] = depth;
    if (depth > near) {
      drawn++;
      if (keys[i] < least) least = keys[i];
      if (keys[i] > most) most = keys[i];
    }
  }
  const scale = (BUCKETS - 1) / Math.max(1, most - least);
  starts.fill(0);
  for (let i = 0; i < count; i++)
    if (depths[i] > near) starts[((most - keys[i]) * scale) | 0]++;
  for (let bucket = 0, sum = 0; bucket < BUCKETS; bucket++) {
    const here = starts[bucket];
    starts[bucket] = sum;
    sum += here;
  }
  const order = new Uint32Array(drawn);
  for (let i = 0; i < count; i++)
    if (depths[i] > near) order[starts[((most - keys[i]) * scale) | 0]++] = i;
  return order;
}

// How far away along a ray, a unit vector, the first half of the light ends; undefined where less
// of it ends at all.
function surface({ position, ray, near }) {
  const hits = [];
  for (let i = 0; i < depths.length; i++) {
    const away = [0, 1, 2].map((axis) => positions[3 * i + axis] - position[axis]);
    const along = away[0] * ray[0] + away[1] * ray[1] + away[2] * ray[2];
    if (along <= near) continue;
    const beside = away[0] ** 2 + away[1] ** 2 + away[2] ** 2 - along ** 2;
    const size = sizes[i] + 0.002 * along; // a finger is no needle
    const alpha = opacities[i] * Math.exp(-0.5 * beside / (size * size));
    if (alpha > 0.02) hits.push([along, alpha]);
  }
  hits.sort((a, b) => a[0] - b[0]);
  let left = 1;
  for (const [along, alpha] of hits) if ((left *= 1 - alpha) < 0.5) return along;
  return undefined;
}

onmessage = ({ data }) => {
  if (data.positions) {
    ({ positions, opacities, sizes } = data);
    depths = new Float32Array(positions.length / 3);
    keys = new Uint32Array(depths.buffer);
    starts = new Uint32Array(BUCKETS);
  } else if (data.ray) {
    postMessage({ picked: { ...data, along: surface(data) } });
  } else {
    const order = sorted(data);
    postMessage({ order }, [order.buffer]);
  }
};

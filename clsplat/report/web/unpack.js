// Embedded gaussians as words for the tables of web/draw.js (written by clsplat/report/model_page.py).
"use strict";

const RECENT = "use a recent version of Chrome, Edge, Firefox or Safari";

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// The bytes of a stream, whose number is known; told(share) is called on the way.
async function bytesFrom(stream, total, told) {
  const bytes = new Uint8Array(total), reader = stream.getReader();
  for (let at = 0; ;) {
    const { done, value } = await reader.read();
    if (done) return bytes;
    bytes.set(value, at);
    told((at += value.length) / total);
  }
}

// Texels of the harmonics of a gaussian.
function texelsOf(degree) { return Math.ceil(3 * degree * (degree + 2) / 16); }

// So many gaussians of a part of the page.
async function unpack(base64, model, count, told) {
  if (!globalThis.DecompressionStream)
    throw new Error(`this browser is too old to unpack it; ${RECENT}`);
  const stream = new Blob([bytesOf(base64)]).stream()
    .pipeThrough(new DecompressionStream("deflate-raw"));
  const { degree } = model, harmonics = 3 * degree * (degree + 2);
  const planes = await bytesFrom(stream, count * (20 + harmonics), told);
  const plane = (index) => planes.subarray(index * count, (index + 1) * count);
  const [middle, unit, low, size] = model.positions; // as _places of page.py
  // place: position, colour and opacity; shape: logarithms of the scales, quaternion
  const places = new Uint32Array(4 * count), shapes = new Uint32Array(2 * count);
  const positions = new Float32Array(places.buffer);
  const placeBytes = new Uint8Array(places.buffer), shapeBytes = new Uint8Array(shapes.buffer);
  for (let axis = 0; axis < 3; axis++) {
    const bytes = [plane(axis), plane(axis + 3), plane(axis + 6)];
    const step = size[axis] / (2 ** 24 - 1);
    for (let i = 0; i < count; i++) {
      const steps = bytes[0][i] << 16 | bytes[1][i] << 8 | bytes[2][i];
      positions[4 * i + axis] = middle[axis] + unit[axis] * Math.sinh(low[axis] + step * steps);
    }
  }
  for (let k = 0; k < 3; k++) scatter(plane(9 + k), shapeBytes, k, 8);
  for (let k = 0; k < 4; k++) scatter(plane(12 + k), placeBytes, 12 + k, 16);
  for (let k = 0; k < 4; k++) scatter(plane(16 + k), shapeBytes, 4 + k, 8);
  const texels = texelsOf(degree), rest = new Uint32Array(4 * texels * count);
  const restBytes = new Uint8Array(rest.buffer);
  for (let k = 0; k < harmonics; k++) scatter(plane(20 + k), restBytes, k, 16 * texels);
  return { places, shapes, rest };
}

// Write a plane into every stride-th byte of a table, from `first` on.
function scatter(plane, table, first, stride) {
  for (let i = 0, at = first; i < plane.length; i++, at += stride) table[at] = plane[i];
}

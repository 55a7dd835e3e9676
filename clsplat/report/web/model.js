// The page of a model: unpacks it, and draws it whenever the camera has moved.
"use strict";

const SHARPEST = 2; // pixels of the picture for each pixel of the style sheet
const SLOW_FRAME = 45; // milliseconds; slower movement is drawn with fewer pixels
const COARSEST = 0.4; // share of the pixels along a side, while the camera moves
const SETTLED = 200; // milliseconds without movement, after which all pixels are drawn

class Viewer {
  constructor(canvas, model, unpacked) {
    Object.assign(this, { canvas, model });
    this.painter = new Painter(canvas, model, unpacked);
    this.worker = this.sorter(unpacked);
    this.camera = new ReaderCamera(model);
    this.controls = new Controls(canvas, this.camera, () => this.moved(),
                                 (x, y) => this.pick(x, y));
    Object.assign(this, { detail: 1, scheduled: false, sorting: false, sharp: false });
    new ResizeObserver(() => this.schedule()).observe(canvas);
    this.sort();
  }

  sorter({ positions, places, shapes }) {
    const { count, logScales: [low, size] } = this.model;
    const opacities = new Float32Array(count), sizes = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      opacities[i] = (places[4 * i + 3] >>> 24) / 255;
      const scale = (k) => low[k] + size[k] * (shapes[2 * i] >>> 8 * k & 255) / 255;
      const [a, b, c] = [scale(0), scale(1), scale(2)];
      sizes[i] = Math.exp(a + b + c - Math.max(a, b, c) - Math.min(a, b, c)); // the middle one
    }
    const source = document.getElementById("sort").textContent;
    const worker = new Worker(URL.createObjectURL(new Blob([source])));
    worker.onmessage = ({ data }) => this.receive(data);
    worker.onerror = ({ message }) => fail(message || "this browser allows no worker");
    worker.postMessage({ positions, opacities, sizes },
                       [positions.buffer, opacities.buffer, sizes.buffer]);
    return worker;
  }

  receive({ order, picked }) {
    if (order) {
      this.painter.reorder(order);
      this.sorting = false;
      this.ordered = true;
      if (this.stale) this.sort();
    } else if (picked.along) {
      this.camera.lookAt(plus(picked.position, picked.ray, picked.along));
      this.moved();
    }
    this.schedule();
  }

  // Turn to the surface that the reader sees at a place of the canvas, which becomes the centre.
  pick(x, y) {
    const ray = this.camera.ray(x, y, this.canvas.clientWidth, this.canvas.clientHeight);
    this.worker.postMessage({ ray, position: this.camera.position, near: this.model.near });
  }

  moved() {
    this.movedAt = performance.now();
    this.sort();
    this.schedule();
  }

  // Order the gaussians for the camera as it is now, or as soon as the worker is free.
  sort() {
    this.stale = this.sorting;
    if (this.sorting) return;
    this.sorting = true;
    this.worker.postMessage({ forward: this.camera.axes()[2], position: this.camera.position,
                              near: this.model.near });
  }

  schedule() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.scheduled = false;
    const pause = now - this.drawnAt;
    if (this.controls.isFlying) {
      this.controls.fly(pause / 1000 || 0);
      this.moved();
    }
    const moving = now - this.movedAt < SETTLED;
    if (moving && this.wasMoving) { // as many pixels as the device can draw in time
      this.detail *= pause > SLOW_FRAME ? Math.max(0.5, Math.sqrt(SLOW_FRAME / pause))
        : pause < SLOW_FRAME / 2 ? 1.05 : 1;
      this.detail = Math.min(1, Math.max(COARSEST, this.detail));
    }
    this.draw(moving ? this.detail : 1);
    Object.assign(this, { wasMoving: moving, drawnAt: now });
    if (moving) this.schedule();
  }

  // Draw the picture with a share of its pixels along each side.
  draw(detail) {
    const { canvas } = this, scale = Math.min(devicePixelRatio, SHARPEST) * detail;
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height)
      Object.assign(canvas, { width, height });
    this.painter.draw(this.camera.pinhole(width, height));
    this.sharp = this.ordered && !this.sorting && detail === 1; // nothing is left to be done
    if (this.ordered) say("");
  }
}

function say(text) { document.getElementById("notice").textContent = text; }

function fail(reason) {
  document.body.classList.add("broken");
  say(`The model cannot be shown: ${reason}.`);
}

async function start() {
  const read = (name) => document.getElementById(name).textContent;
  const canvas = document.getElementById("picture"), model = JSON.parse(read("model"));
  document.getElementById("facts").textContent = `${model.count.toLocaleString("en")} gaussians`;
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => location.reload());
  try {
    const unpacked = await unpack(read("gaussians"), model, (share) => say(
      `Unpacking the model … ${Math.round(100 * share)} %`));
    document.getElementById("gaussians").remove(); // its memory
    globalThis.viewer = new Viewer(canvas, model, unpacked);
  } catch (error) {
    fail(error.message);
    throw error;
  }
}

start();

// The page of a model: unpacks it, and draws it whenever the camera has moved.
"use strict";

const SHARPEST = 2; // pixels of the picture for each pixel of the style sheet
const SLOW_FRAME = 45; // milliseconds; slower movement is drawn with fewer pixels
const COARSEST = 0.4; // share of the pixels along a side, while the camera moves
const SETTLED = 200; // milliseconds without movement, after which all pixels are drawn

class Viewer {
  constructor(canvas, model) {
    Object.assign(this, { canvas, model });
    this.cells = new Cells(model);
    this.painter = new Painter(canvas, model, this.cells.rows);
    this.worker = this.sorter();
    this.asked = new Map();
    this.camera = new ReaderCamera(model);
    Object.assign(this, { detail: 1, scheduled: false, sorting: false, sharp: false });
    this.tools = new Tools(this, [Photos, Measure]);
    this.looks = new Looks(this);
    new ResizeObserver(() => this.schedule()).observe(canvas);
    this.load().catch(({ message }) => fail(message));
  }

  sorter() {
    const source = document.getElementById("sort").textContent;
    const worker = new Worker(URL.createObjectURL(new Blob([source])));
    worker.onmessage = ({ data }) => this.receive(data);
    worker.onerror = ({ message }) => fail(message || "this browser allows no worker");
    worker.postMessage({ logScales: this.model.logScales });
    return worker;
  }

  // Fill the tables: what shows all of the model first, and then, for ever, the cells that lack.
  async load() {
    const { cells } = this;
    if (cells.coarse) {
      await this.take("coarse", cells.coarse, 0);
      this.sort();
    }
    for (let sorted = 0, loaded = 0; ; ) {
      const missing = cells.missing(this.camera);
      this.isComplete = !missing;
      if (!missing) {
        if (cells.isWhole) return;
        await new Promise((wake) => { this.wake = wake; });
        continue;
      }
      const { cell, slot } = missing, replaces = cells.slots[slot];
      await this.take(`cell${cell.number}`, cell.count, cells.first(slot));
      cells.put(missing);
      if (++loaded >= 2 * sorted || replaces || !cells.missing(this.camera)) { // each costs a frame
        this.isComplete = !cells.missing(this.camera);
        this.sort();
        sorted = loaded;
      }
      this.tell();
    }
  }

  // Unpack a part of the page, when it has arrived, into the tables.
  async take(name, count, first) {
    while (!isThere(name)) {
      const share = arrived(name) / this.model.characters[name];
      if (!this.ordered) say(`Loading the model … ${Math.round(100 * share)} %`);
      await new Promise((wake) => setTimeout(wake, 100));
    }
    const element = document.getElementById(name);
    const part = await unpack(element.textContent, this.model, count, (share) => {
      if (!this.ordered) say(`Unpacking the model … ${Math.round(100 * share)} %`);
    });
    if (name === "coarse" || this.cells.isWhole) element.remove(); // its memory
    this.painter.fill(first, part);
    const { places, shapes } = part;
    this.worker.postMessage({ first, places, shapes }, [places.buffer, shapes.buffer]);
    this.hasPart = true;
  }

  tell() {
    const { coarse, share, isWhole } = this.cells;
    const loaded = !coarse ? "" : share < 1 ? ` · ${Math.round(100 * share)} % of the details loaded`
      : isWhole ? "" : " · details near the camera";
    document.getElementById("facts").textContent =
      `${this.model.count.toLocaleString("en")} gaussians${loaded}`;
  }

  receive({ order, asked, along }) {
    if (order) {
      this.painter.reorder(order);
      this.sorting = false;
      this.ordered = true;
      if (this.stale) this.sort();
    } else {
      this.asked.get(asked)(along);
      this.asked.delete(asked);
    }
    this.schedule();
  }

  // The place that the reader sees at a place of the canvas; undefined if there is nothing.
  async surfaceAt(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    const ray = this.camera.ray(x, y, clientWidth, clientHeight);
    const camera = this.camera.pinhole(clientWidth, clientHeight);
    const asked = this.count = (this.count || 0) + 1;
    const along = await new Promise((answer) => {
      this.asked.set(asked, answer);
      this.worker.postMessage({ asked, ray, x, y, near: this.model.near, cut: this.looks.box,
                                camera: { ...camera, ratios: ratiosOf(camera) } });
    });
    return along && plus(camera.position, ray, along);
  }

  moved() {
    this.movedAt = performance.now();
    if (this.wake) this.wake();
    this.sort();
    this.schedule();
  }

  // Order the gaussians for the camera as it is now, or as soon as the worker is free.
  sort() {
    this.stale = this.sorting;
    if (this.sorting || !this.hasPart) return;
    this.sorting = true;
    this.worker.postMessage({ forward: this.camera.axes()[2], position: this.camera.position,
                              near: this.model.near, ranges: this.cells.ranges(this.hasty) });
  }

  schedule() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.scheduled = false;
    const pause = now - this.drawnAt;
    if (this.tools.controls.isFlying) {
      this.tools.controls.fly(pause / 1000 || 0);
      this.moved();
    }
    const moving = now - this.movedAt < SETTLED;
    if (moving && this.wasMoving) { // as many pixels as the device can draw in time
      this.detail *= pause > SLOW_FRAME ? Math.max(0.5, Math.sqrt(SLOW_FRAME / pause))
        : pause < SLOW_FRAME / 2 ? 1.05 : 1;
      this.detail = Math.min(1, Math.max(COARSEST, this.detail));
    }
    const hasty = moving && this.detail === COARSEST; // too slow for all gaussians
    if (hasty !== this.hasty) {
      this.hasty = hasty;
      this.sort();
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
    // nothing is left to be done
    this.sharp = this.isComplete && !this.sorting && !this.hasty && detail === 1;
    this.tools.update();
    if (this.ordered) {
      say("");
      document.getElementById("poster")?.remove();
    }
  }
}

function say(text) { document.getElementById("notice").textContent = text; }

function fail(reason) {
  document.body.classList.add("broken");
  say(`The model cannot be shown: ${reason}.`);
}

// Whether all of an element of the page has arrived.
function isThere(name) {
  return document.readyState !== "loading" || document.getElementById(name)?.nextElementSibling;
}

// How many characters of an element have arrived.
function arrived(name) {
  const { childNodes } = document.getElementById(name) || { childNodes: [] };
  return [...childNodes].reduce((sum, { length }) => sum + length, 0);
}

function start() {
  const canvas = document.getElementById("picture");
  const model = JSON.parse(document.getElementById("model").textContent);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => location.reload());
  try {
    globalThis.viewer = new Viewer(canvas, model);
    viewer.tell();
  } catch (error) {
    fail(error.message);
    throw error;
  }
}

start();

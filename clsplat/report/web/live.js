// A live page: shows frames that clsplat draws, and how its training goes.
"use strict";

const ASK_STATUS = 1000; // milliseconds
const REFRESH = 1500; // milliseconds between frames of a training, without movement
const SETTLED = 250; // milliseconds without movement, after which all pixels are asked for
const MOST_PIXELS = 1.6e6, QUICK = 120; // of a frame; milliseconds that one may take in movement
const COARSEST = 0.2; // share of the pixels along a side

const pause = (milliseconds) => new Promise((wake) => setTimeout(wake, milliseconds));
const say = (text) => { element("notice").textContent = text; };

class LiveView {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.camera = new ReaderCamera(view);
    Object.assign(this, { detail: 0.5, movedAt: 0, status: {}, ended: false, stale: true });
    this.tools = new Tools(this);
    new ResizeObserver(() => { this.stale = true; }).observe(canvas);
    this.pollStatus();
    this.showFrames();
  }

  moved() {
    this.movedAt = performance.now();
    this.stale = true;
  }

  // The server's answer to a camera, or undefined where it has none yet.
  async ask(what, camera) {
    try {
      const answer = await fetch(what, { method: "POST", body: JSON.stringify(camera) });
      if (answer.ok) return answer;
      if (answer.status === 500) say(await answer.text());
    } catch {
      this.end();
    }
    return undefined;
  }

  async showFrames() {
    for (let before = performance.now(); !this.ended; ) {
      const now = performance.now();
      if (this.tools.controls.isFlying) {
        this.tools.controls.fly((now - before) / 1000);
        this.moved();
      }
      before = now;
      const due = this.training && now - (this.askedAt || 0) > REFRESH;
      const moving = now - this.movedAt < SETTLED;
      if (this.stale || due || (this.coarse && !moving)) await this.show(moving ? this.detail : 1);
      else await new Promise((wake) => requestAnimationFrame(wake));
    }
  }

  // Ask for a frame with a share of the canvas's pixels along each side, and show it.
  async show(detail) {
    const { clientWidth, clientHeight } = this.canvas;
    const most = Math.sqrt(MOST_PIXELS / (clientWidth * clientHeight));
    const scale = Math.min(devicePixelRatio, most) * detail, began = performance.now();
    const width = Math.max(1, Math.round(clientWidth * scale));
    const height = Math.max(1, Math.round(clientHeight * scale));
    this.askedAt = began;
    this.stale = false;
    const answer = await this.ask("frame", this.camera.pinhole(width, height));
    if (!answer) {
      this.stale = true;
      await pause(300);
      return;
    }
    const picture = await createImageBitmap(await answer.blob());
    Object.assign(this.canvas, { width, height });
    this.canvas.getContext("2d").drawImage(picture, 0, 0);
    this.tools.update();
    this.coarse = detail < 1;
    this.shown = (this.shown || 0) + 1;
    if (!this.ended) say(""); // the notice of the end stays, whatever was on its way
    if (this.coarse) { // a training draws when it has time: the fewer pixels the sooner
      const change = performance.now() - began > QUICK ? 0.85 : 1.1;
      this.detail = Math.min(1, Math.max(COARSEST, this.detail * change));
    }
  }

  // See Tools.
  async surfaceAt(x, y) {
    const { clientWidth, clientHeight } = this.canvas;
    const camera = this.camera.pinhole(clientWidth, clientHeight);
    const ray = this.camera.ray(x, y, clientWidth, clientHeight);
    const centre = [camera.centre[0] - x + 1, camera.centre[1] - y + 1]; // of 2 x 2 pixels
    const answer = await this.ask("depth", { ...camera, width: 2, height: 2, centre });
    const { depth } = answer ? await answer.json() : {};
    return depth && plus(camera.position, ray, depth / dot(ray, camera.rotation[2]));
  }

  async pollStatus() {
    while (!this.ended) {
      try {
        const answer = await fetch("status");
        if (answer.ok) this.report(await answer.json());
      } catch {
        this.end();
      }
      await pause(ASK_STATUS);
    }
  }

  report(status) {
    this.training = "losses" in status;
    const { iteration, total, gaussians, loss, losses, phase, message } = status;
    const count = (number) => number.toLocaleString("en");
    const facts = [gaussians ? `${count(gaussians)} gaussians` : phase];
    if (iteration) facts.unshift(`step ${count(iteration)} of ${count(total)}`);
    element("facts").textContent = facts.join(" · ");
    element("progress").hidden = !iteration;
    if (iteration) {
      element("progress").firstElementChild.style.width = `${100 * iteration / total}%`;
      element("numbers").textContent = `${phase} · loss ${loss.toFixed(4)}`;
      element("message").textContent = message;
    }
    element("losses").toggleAttribute("hidden", !(losses && losses.length > 2));
    if (losses && losses.length > 2) {
      const heights = losses.map(([, value]) => Math.log(value));
      const low = Math.min(...heights), size = Math.max(...heights) - low || 1;
      const last = losses[losses.length - 1][0];
      element("losses").firstElementChild.setAttribute("points", losses.map(
        ([step], i) => `${100 * step / last},${100 - 100 * (heights[i] - low) / size}`).join(" "));
    }
  }

  end() {
    this.ended = true;
    say(this.training ? "The training has ended or was stopped. Its model: clsplat view RUN"
      : "This page has ended. To go on: clsplat view RUN");
  }
}

globalThis.viewer = new LiveView(element("picture"), JSON.parse(element("model").textContent));

// How mouse, touch and keyboard move a ReaderCamera.
"use strict";

const TURN = 0.005; // radians a pixel of dragging
const FLIGHT = 0.6; // distances to the centre a second
const READ = 6000; // milliseconds after the first movement, in which the help is still shown
const LONGEST_PAUSE = 0.1; // seconds that a frame of a flight may count
const FIRST_STEP = 0.03; // seconds of flight that a key counts at least, be frames ever so slow
const TAPS_APART = 350, SAME_PLACE = 25; // milliseconds and pixels: a double tap is within them
const FLY_KEYS = {
  KeyW: [0, 0, 1], ArrowUp: [0, 0, 1], KeyS: [0, 0, -1], ArrowDown: [0, 0, -1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0], KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
};
const KEYS = { KeyR: "reset", KeyO: "orbit", KeyF: "fly", KeyH: "explain", KeyT: "open",
               KeyM: "measure", KeyZ: "undo", KeyC: "cameras", KeyG: "by_height",
               KeyX: "fullscreen", KeyL: "link" };
const RISE_KEYS = { KeyE: 1, PageUp: 1, KeyQ: -1, PageDown: -1 };

class Controls {
  // surface: the element that is dragged; changed(): called after each movement; picked(x, y):
  // called with the place of a double click, in pixels of the style sheet; tapped(x, y): of each
  // press that moved nothing.
  constructor(surface, camera, changed, picked, tapped) {
    Object.assign(this, { surface, camera, changed, picked, tapped });
    this.pointers = new Map();
    this.keys = new Set();
    this.lastTap = { time: -Infinity, x: 0, y: 0 };
    surface.addEventListener("pointerdown", (event) => this.press(event));
    surface.addEventListener("pointermove", (event) => this.drag(event));
    surface.addEventListener("pointerup", (event) => this.release(event));
    surface.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    surface.addEventListener("contextmenu", (event) => event.preventDefault());
    surface.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => this.keyUp(event));
    addEventListener("blur", () => this.keys.clear());
    this.button("orbit", () => this.setFlying(false));
    this.button("fly", () => this.setFlying(true));
    this.button("reset", () => { camera.reset(); changed(); });
    this.button("explain", () => this.showHelp(document.getElementById("help").hidden));
    this.setFlying(false);
    this.showHelp(true);
    // who has moved for a while knows how
    const hide = () => { this.hiding = setTimeout(() => this.showHelp(false), READ); };
    for (const name of ["pointerdown", "wheel"])
      surface.addEventListener(name, hide, { once: true, passive: true });
  }

  button(name, act) {
    document.getElementById(name).addEventListener("click", () => {
      act();
      this.surface.focus({ preventScroll: true });
    });
  }

  setFlying(flying) {
    this.flying = flying;
    for (const [mode, active] of [["fly", flying], ["orbit", !flying]]) {
      document.getElementById(mode).setAttribute("aria-pressed", active);
      document.body.classList.toggle(mode, active);
    }
  }

  showHelp(shown) {
    clearTimeout(this.hiding);
    document.getElementById("help").hidden = !shown;
    document.getElementById("explain").setAttribute("aria-expanded", shown);
  }

  press(event) {
    this.surface.setPointerCapture(event.pointerId);
    this.surface.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const isSecond = event.timeStamp - this.lastTap.time < TAPS_APART && this.pointers.size === 1
      && event.button === 0 && this.isAtLastTap(event);
    this.isStill = this.pointers.size === 1;
    this.lastTap = { time: isSecond ? -Infinity : event.timeStamp, x: event.clientX,
                     y: event.clientY };
    if (isSecond) this.picked(event.clientX, event.clientY);
  }

  release(event) {
    const isTap = this.pointers.size === 1 && this.isStill && event.button === 0;
    if (this.pointers.delete(event.pointerId) && isTap) this.tapped(event.clientX, event.clientY);
  }

  isAtLastTap({ clientX, clientY }) {
    return Math.hypot(clientX - this.lastTap.x, clientY - this.lastTap.y) < SAME_PLACE;
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    if (!this.isAtLastTap(event)) { // a drag is no tap
      this.lastTap.time = -Infinity;
      this.isStill = false;
    }
    const before = this.fingers();
    Object.assign(last, { x: event.clientX, y: event.clientY });
    const after = this.fingers();
    const dx = after.x - before.x, dy = after.y - before.y;
    if (this.pointers.size > 1) {
      if (before.spread && after.spread)
        this.camera.zoom(before.spread / after.spread, this.rayTo(after.x, after.y));
      this.pan(dx, dy);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.pan(dx, dy);
    } else if (this.flying) {
      this.camera.look(dx * TURN, dy * TURN);
    } else {
      this.camera.orbit(-dx * TURN, -dy * TURN);
    }
    this.changed();
  }

  // The middle of all pointers, and how far they are apart.
  fingers() {
    const all = [...this.pointers.values()];
    const x = all.reduce((sum, each) => sum + each.x, 0) / all.length;
    const y = all.reduce((sum, each) => sum + each.y, 0) / all.length;
    return { x, y, spread: Math.hypot(all[0].x - x, all[0].y - y) };
  }

  // Move the camera so that what lies at the centre follows the pointer.
  pan(dx, dy) {
    const { clientWidth, clientHeight } = this.surface;
    const length = this.camera.distance / this.camera.pinhole(clientWidth, clientHeight).focal[0];
    this.camera.move(-dx * length, -dy * length, 0);
  }

  wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : 1; // some browsers count lines
    const factor = Math.exp(Math.min(0.5, Math.max(-0.5, event.deltaY * lines * 0.0015)));
    if (this.flying) this.camera.move(0, 0, (1 - factor) * this.camera.distance);
    else this.camera.zoom(factor, this.rayTo(event.clientX, event.clientY));
    this.changed();
  }

  rayTo(x, y) {
    return this.camera.ray(x, y, this.surface.clientWidth, this.surface.clientHeight);
  }

  keyDown(event) {
    this.fast = event.shiftKey; // which may be pressed after the key that moves
    if (event.ctrlKey || event.metaKey || event.altKey
        || event.target.matches?.("[type=text], [type=range]")) return;
    if (event.code in FLY_KEYS || event.code in RISE_KEYS) {
      event.preventDefault();
      this.keys.add(event.code);
      if (!event.repeat) this.fly(FIRST_STEP);
      this.changed();
    } else if (!event.repeat) {
      const act = event.key === "?" ? "explain" // wherever the keyboard has it
        : KEYS[event.code];
      document.getElementById(act)?.click();
    }
  }

  keyUp(event) {
    this.fast = event.shiftKey;
    this.keys.delete(event.code);
  }

  // Whether keys are held that move the camera.
  get isFlying() { return this.keys.size > 0; }

  // Fly for some seconds, as the keys say.
  fly(seconds) {
    const length = Math.min(seconds, LONGEST_PAUSE) * FLIGHT * this.camera.distance
      * (this.fast ? 4 : 1);
    for (const key of this.keys) {
      if (key in RISE_KEYS) this.camera.rise(RISE_KEYS[key] * length);
      else this.camera.move(...FLY_KEYS[key].map((along) => along * length));
    }
    this.camera.level();
  }
}

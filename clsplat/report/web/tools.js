// What lies beside and over the picture: the panel of tools, views that can be kept and sent,
// coordinates, the scale and where north is.
"use strict";

const GLIDE = 500; // milliseconds, from one view to another
const LONGEST_BAR = 110; // pixels
const element = (name) => document.getElementById(name);

class Tools {
  // viewer: has the canvas, the camera, moved(), and surfaceAt(x, y), which promises a place in the
  // world; parts: classes of tools, each with a method update(overlay) and perhaps tapped(x, y).
  constructor(viewer, parts = [Measure]) {
    Object.assign(this, { viewer, camera: viewer.camera, place: viewer.camera.view.place });
    const { canvas } = viewer;
    this.controls = new Controls(
      canvas, this.camera, () => { this.flight = null; viewer.moved(); },
      (x, y) => this.centre(x, y), (x, y) => this.tapped(x, y));
    this.parts = parts.map((Part) => new Part(this));
    this.controls.button("open", () => this.open(element("tools").hidden));
    canvas.addEventListener("pointermove", (event) => event.buttons || this.point(event));
    this.controls.button("north", () => this.turnNorth());
    element("north").hidden = !this.place.metric;
    this.controls.button("fullscreen", () => (document.fullscreenElement
      ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
    element("fullscreen").hidden = !document.fullscreenEnabled;
    this.controls.button("link", () => this.copyLink());
    element("keep").addEventListener("submit", (event) => this.keep(event));
    this.listKept();
    addEventListener("hashchange", () => this.follow());
    this.follow();
  }

  open(shown) {
    element("tools").hidden = !shown;
    element("open").setAttribute("aria-expanded", shown);
  }

  async centre(x, y) {
    if (this.parts.some(({ isTaking }) => isTaking)) return;
    const place = await this.viewer.surfaceAt(x, y);
    if (!place) return;
    this.camera.lookAt(place);
    this.viewer.moved();
  }

  tapped(x, y) {
    for (const part of this.parts) if (part.tapped && part.tapped(x, y)) return;
    this.point({ clientX: x, clientY: y });
  }

  // Go to a view, at once where the reader wants no motion.
  go(pose, arrived = () => {}) {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const from = this.camera.pose, began = performance.now(), flight = this.flight = {};
    const turn = pose[3] - from[3]; // the short way round
    from[3] += 2 * Math.PI * Math.round(turn / (2 * Math.PI));
    const step = (now) => {
      if (this.flight !== flight) return;
      const share = still ? 1 : clamped((now - began) / GLIDE, 0, 1);
      const eased = share * share * (3 - 2 * share);
      this.camera.pose = share < 1 ? from.map((value, k) => value + eased * (pose[k] - value)) : pose;
      this.viewer.moved();
      if (share < 1) requestAnimationFrame(step);
      else arrived();
    };
    step(began);
  }

  // --- views that are kept, and sent as links

  get link() {
    return `${location.href.replace(/#.*/, "")}#view=${
      this.camera.pose.map((value) => +value.toPrecision(9)).join(",")}`;
  }

  // Go where the address of the page says; anything else in it is passed over.
  follow() {
    const pose = (/^#view=([-\d.e,+]+)$/.exec(location.hash)?.[1] || "").split(",").map(Number);
    if (pose.length !== 10 || !pose.every(Number.isFinite) || !(pose[9] > 0.01)) return;
    this.camera.pose = pose;
    this.camera.distance = this.camera.limited(pose[5]);
    this.camera.place(this.camera.position);
    this.viewer.moved();
  }

  async copyLink() {
    location.hash = this.link.split("#")[1];
    try {
      await navigator.clipboard.writeText(this.link);
      element("told").textContent = "The link to this view was copied.";
    } catch {
      element("told").textContent = "The address of the page is now that of this view.";
    }
  }

  get kept() {
    try { return JSON.parse(localStorage.getItem(this.store)) || []; } catch { return []; }
  }

  get store() { return `clsplat ${document.title} ${this.camera.view.position}`; }

  keep(event) {
    event.preventDefault();
    const name = element("name").value.trim() || `View ${this.kept.length + 1}`;
    this.keepAll([...this.kept, { name, pose: this.camera.pose }]);
    element("name").value = "";
  }

  keepAll(kept) {
    try {
      localStorage.setItem(this.store, JSON.stringify(kept));
      element("told").textContent = "";
    } catch {
      element("told").textContent = "This browser keeps nothing for this page; send a link instead.";
    }
    this.listKept();
  }

  listKept() {
    element("kept").replaceChildren(...this.kept.map(({ name, pose }, number) => {
      const row = document.createElement("li");
      row.append(button(name, () => this.go(pose)),
                 button("×", () => this.keepAll(this.kept.filter((_, k) => k !== number)),
                        `Forget ${name}`));
      return row;
    }));
  }

  // --- coordinates, scale and north

  // Show the coordinates of what is under the pointer; one question at a time is asked.
  async point({ clientX, clientY }) {
    this.wanted = [clientX, clientY];
    if (this.pointing) return;
    this.pointing = true;
    while (this.wanted) {
      const at = this.wanted;
      this.wanted = null;
      element("place").textContent = this.coordinates(await this.viewer.surfaceAt(...at));
    }
    this.pointing = false;
  }

  // Coordinates of a place of the world in the CRS of the run, or in its scene's own coordinates.
  coordinates(place) {
    if (!place) return "";
    const { metric, crs, offset } = this.place, [x, y, z] = plus(place, offset);
    return metric ? `E ${x.toFixed(2)} · N ${y.toFixed(2)} · height ${z.toFixed(2)} m · ${crs}`
      : `x ${brief(x)} · y ${brief(y)} · z ${brief(z)} · scene units`;
  }

  get unit() { return this.place.metric ? "m" : "units"; }

  turnNorth() {
    const { north, west } = this.camera, centre = this.camera.centre(), pose = this.camera.pose;
    pose[3] = Math.atan2(west[1], north[1]);
    const turned = Object.assign(Object.create(ReaderCamera.prototype), this.camera);
    turned.pose = pose;
    turned.tilt = [0, 0, 0];
    turned.place(plus(centre, turned.axes()[2], -turned.distance));
    this.go(turned.pose);
  }

  // Bring all that lies over the picture to the camera as it is now.
  update() {
    const { clientWidth, clientHeight } = this.viewer.canvas, { camera } = this;
    const pixel = camera.distance / camera.pinhole(clientWidth, clientHeight).focal[0];
    const most = LONGEST_BAR * pixel, power = 10 ** Math.floor(Math.log10(most));
    const length = power * [5, 2, 1].find((step) => step * power <= most);
    element("bar_length").style.width = `${length / pixel}px`;
    element("scale").lastElementChild.textContent = `${brief(length)} ${
      length === 1 && !this.place.metric ? "unit" : this.unit}`;
    const ahead = Math.atan2(camera.west[1], camera.north[1]) - camera.heading;
    element("north").firstElementChild.style.transform = `rotate(${-ahead}rad)`;
    const shown = this.parts.map((part) => part.update(
      (point) => camera.project(point, clientWidth, clientHeight))).join("");
    if (shown !== this.shown) element("overlay").innerHTML = this.shown = shown;
  }
}

function brief(value) { return String(+value.toPrecision(4)); }

function button(text, act, label = text) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.setAttribute("aria-label", label);
  made.addEventListener("click", act);
  return made;
}

// SVG of a line through points of the picture; what lies behind the camera is left out.
function line(points, kind) {
  let path = "", drawn = false;
  for (const [x, y, depth] of points) {
    if (depth > 0) path += `${drawn ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
    drawn = depth > 0;
  }
  return `<path class="${kind}" d="${path}"/>`;
}

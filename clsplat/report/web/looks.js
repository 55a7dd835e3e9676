// How the model is shown: coloured by height, and cut by a box.
"use strict";

const STEPS = 1000; // of a slider

class Looks {
  constructor(viewer) {
    Object.assign(this, { viewer, box: undefined });
    const { painter, camera: { up, view } } = viewer, legend = element("legend");
    element("by_height").addEventListener("change", ({ target: { checked } }) => {
      painter.colourByHeight(up, checked ? view.heights : undefined);
      legend.hidden = !checked;
      viewer.schedule();
    });
    const { offset, metric } = view.place;
    const shown = (height) => (metric ? `${(height + dot(offset, up)).toFixed(1)} m` : brief(height));
    legend.children[0].textContent = shown(view.heights[0]);
    legend.children[1].style.background = `linear-gradient(90deg, ${
      PALETTE.map((rgb) => `rgb(${rgb})`).join()})`;
    legend.children[2].textContent = shown(view.heights[1]);
    const names = metric ? ["West", "East", "South", "North"] : ["Left", "Right", "Front", "Back"];
    this.sliders = [...names, "Bottom", "Top", "Turn"].map((name, k) => this.slider(
      name, k < 6 && k % 2 ? STEPS : 0));
    element("uncut").addEventListener("click", () => {
      this.sliders.forEach((slider) => { slider.value = slider.defaultValue; });
      this.cut();
    });
  }

  slider(name, value) {
    const label = document.createElement("label"), slider = document.createElement("input");
    Object.assign(slider, { type: "range", min: 0, max: STEPS, defaultValue: value });
    slider.addEventListener("input", () => this.cut());
    label.append(name, slider);
    element("cut").append(label);
    return slider;
  }

  // Cut as the sliders say: a box whose axes are level and upright, turned by up to 90 degrees.
  cut() {
    const { painter, camera: { up, north, west, view: { bounds } } } = this.viewer;
    const shares = this.sliders.map(({ value }) => value / STEPS), turn = shares[6] * Math.PI / 2;
    const axes = [[Math.cos(turn), Math.sin(turn)], [-Math.sin(turn), Math.cos(turn)]].map(
      ([c, s]) => plus(north.map((value) => c * value), west, s)); // named by x, which is east
    axes.push(up);
    // an end of a slider takes away nothing, not even what lies beyond the bounds
    const at = (share, axis, k) => dot(axis, bounds.middle)
      + (2 * share - 1) * (k < 2 ? bounds.radius : bounds.height);
    this.box = shares.slice(0, 6).some((share, k) => share !== k % 2) ? {
      axes,
      low: axes.map((axis, k) => (shares[2 * k] ? at(shares[2 * k], axis, k) : -1e30)),
      high: axes.map((axis, k) => (shares[2 * k + 1] < 1 ? at(shares[2 * k + 1], axis, k) : 1e30)),
    } : undefined;
    painter.cut(this.box);
    this.viewer.schedule();
  }
}

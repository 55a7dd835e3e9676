// Measures between places on the surface: lengths, heights and areas.
"use strict";

class Measure {
  constructor(tools) {
    Object.assign(this, { tools, points: [], isTaking: false });
    const { controls, viewer } = tools;
    controls.button("measure", () => this.take(!this.isTaking));
    controls.button("undo", () => this.keep(this.points.slice(0, -1)));
    controls.button("clear", () => this.keep([]));
    viewer.canvas.addEventListener("keydown", ({ key }) => { // without a mouse: the middle
      if (key === "Enter" && this.isTaking)
        this.tapped(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2);
    });
    this.keep([]);
  }

  take(taking) {
    this.isTaking = taking;
    element("measure").setAttribute("aria-pressed", taking);
    document.body.classList.toggle("measuring", taking);
    if (taking) this.tools.open(true);
    this.keep(this.points);
  }

  tapped(x, y) {
    if (!this.isTaking) return false;
    this.tools.viewer.surfaceAt(x, y).then((place) => {
      if (place) this.keep([...this.points, place]);
      else element("measured").textContent = "There is no surface here; choose another place.";
    });
    return true;
  }

  keep(points) {
    this.points = points;
    for (const name of ["undo", "clear"]) element(name).disabled = !points.length;
    element("measured").textContent = this.report();
    this.tools.viewer.moved();
  }

  // What is known of the points, lines of text.
  report() {
    const { points, tools: { unit, camera: { up }, place } } = this;
    const shown = (value) => (place.metric ? value.toFixed(2) : brief(value));
    if (!points.length) return this.isTaking ? "Click the surface to set points." : "";
    if (points.length < 2) return this.tools.coordinates(points[0]);
    const { length, rise, ground, area, mapArea } = Measure.of(points, up);
    const lines = [`Length ${shown(length)} ${unit}`, `Length on a map ${shown(ground)} ${unit}`,
                   `Height difference ${shown(rise)} ${unit}`];
    if (points.length > 2) lines.push(`Area ${shown(area)} ${unit}²`,
                                      `Area on a map ${shown(mapArea)} ${unit}²`);
    return lines.join("\n");
  }

  update(project) {
    const seen = this.points.map(project);
    const closing = seen.length > 2 ? line([seen[seen.length - 1], seen[0]], "closing") : "";
    return closing + line(seen, "measure") + seen.filter(([, , depth]) => depth > 0).map(
      ([x, y]) => `<circle cx="${x.toFixed(1)}" cy="${y.toFixed(1)}" r="4"/>`).join("");
  }

  // Of a line through points: its length, that on a map, how much higher its end is than its
  // begin, and the area that it encloses with its end joined to its begin, on the plane that fits it
  // and on the level one.
  static of(points, up) {
    let length = 0, ground = 0, vector = [0, 0, 0];
    points.forEach((point, k) => {
      const next = points[(k + 1) % points.length], way = plus(next, point, -1);
      vector = plus(vector, cross(plus(point, points[0], -1), plus(next, points[0], -1)), 0.5);
      if (k === points.length - 1) return;
      length += Math.hypot(...way);
      ground += Math.hypot(...plus(way, up, -dot(way, up)));
    });
    return { length, ground, rise: dot(plus(points[points.length - 1], points[0], -1), up),
             area: Math.hypot(...vector), mapArea: Math.abs(dot(vector, up)) };
  }
}

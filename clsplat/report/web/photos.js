// The photos: a list of them, where they were taken, and each over the picture from its place.
"use strict";

const MARGIN = 0.94; // of the window, which a photo fills
const LENGTH = 0.03; // first distances: of a drawn camera
const NARROW = 560; // pixels: in a window of this width, the panel hides the picture
const TOUCHED = 24; // pixels around a drawn camera

class Photos {
  constructor(tools) {
    Object.assign(this, { tools, all: [], at: -1 });
    const { controls } = tools;
    element("cameras").addEventListener("change", () => tools.viewer.schedule());
    element("fade").addEventListener("input", () => this.fade());
    controls.button("previous", () => this.show(this.at - 1));
    controls.button("next", () => this.show(this.at + 1));
    controls.button("close", () => this.leave());
    if (document.readyState === "loading")
      addEventListener("DOMContentLoaded", () => this.list());
    else this.list();
  }

  list() {
    this.all = JSON.parse(element("photo_record").textContent);
    element("no_photos").hidden = this.all.length > 0;
    element("photos").replaceChildren(...this.all.map(({ name, picture }, number) => {
      const row = document.createElement("li"), choice = button(name, () => this.show(number));
      if (picture) {
        const image = Object.assign(new Image(), { loading: "lazy", alt: "", src: picture });
        choice.prepend(image);
      }
      row.append(choice);
      return row;
    }));
    this.tools.viewer.schedule();
  }

  // Go to where a photo was taken, and lay it over the picture.
  show(number) {
    const { camera, viewer } = this.tools, count = this.all.length;
    this.leave();
    this.tools.controls.showHelp(false);
    if (innerWidth < NARROW) this.tools.open(false);
    this.at = (number + count) % count;
    const photo = this.all[this.at], there = new ReaderCamera(camera.view);
    there.take(photo, camera.distance);
    const { clientWidth: width, clientHeight: height } = viewer.canvas;
    const { focal } = there.pinhole(width, height);
    there.lens = MARGIN * Math.min(width / photo.width * photo.focal[0] / focal[0],
                                   height / photo.height * photo.focal[1] / focal[1]);
    this.tools.go(there.pose, () => {
      this.pose = String(camera.pose);
      element("caption").textContent = photo.name;
      element("photo").hidden = !photo.picture;
      element("fade").parentElement.hidden = !photo.picture;
      if (photo.picture) {
        element("photo").src = photo.picture;
        this.lay(photo, viewer.canvas);
      }
      element("photo").alt = `The photo ${photo.name}`;
      element("card").hidden = false;
      this.fade();
      viewer.schedule();
    });
  }

  fade() { element("photo").style.opacity = element("fade").value / 100; }

  leave() {
    this.pose = undefined;
    element("photo").hidden = element("card").hidden = true;
  }

  // The camera at this place, if those of photos are drawn.
  tapped(x, y) {
    if (!element("cameras").checked) return false;
    const { clientWidth, clientHeight } = this.tools.viewer.canvas;
    let nearest = TOUCHED, number = -1;
    this.all.forEach(({ position }, k) => {
      const [px, py, depth] = this.tools.camera.project(position, clientWidth, clientHeight);
      const away = Math.hypot(px - x, py - y);
      if (depth > 0 && away < nearest) [nearest, number] = [away, k];
    });
    if (number >= 0) this.show(number);
    return number >= 0;
  }

  update(project) {
    const { camera, viewer } = this.tools;
    if (this.pose && this.pose !== String(camera.pose)) this.leave(); // the reader went on
    if (this.pose && this.all[this.at].picture) this.lay(this.all[this.at], viewer.canvas);
    if (!element("cameras").checked || this.pose) return "";
    const length = LENGTH * camera.view.distance;
    return this.all.map((photo, number) => {
      const corner = (x, y) => project(plus(photo.position, [0, 1, 2].map((axis) => length * (
        (x - photo.centre[0]) / photo.focal[0] * photo.rotation[0][axis]
        + (y - photo.centre[1]) / photo.focal[1] * photo.rotation[1][axis]
        + photo.rotation[2][axis]))));
      const { width, height } = photo, tip = project(photo.position);
      const [a, b, c, d] = [corner(0, 0), corner(width, 0), corner(width, height),
                            corner(0, height)];
      return line([tip, a, b, tip, c, d, tip, a, d, tip, b, c],
                  number === this.at ? "camera chosen" : "camera");
    }).join("");
  }

  // Where the photo is in the picture, whose camera has the same place and direction.
  lay(photo, { clientWidth, clientHeight }) {
    const { focal, centre } = this.tools.camera.pinhole(clientWidth, clientHeight);
    const [x, y] = focal.map((length, axis) => length / photo.focal[axis]);
    Object.assign(element("photo").style, {
      width: `${photo.width * x}px`, height: `${photo.height * y}px`,
      left: `${centre[0] - photo.centre[0] * x}px`, top: `${centre[1] - photo.centre[1] * y}px`,
    });
  }
}

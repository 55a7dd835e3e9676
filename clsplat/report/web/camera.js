// The reader's camera. Axes right, down, forward, as everywhere in clsplat; the world's vertical
// stays vertical in the picture.
"use strict";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                         a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, factor = 1) => a.map((value, axis) => value + factor * b[axis]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const clamped = (value, low, high) => Math.min(high, Math.max(low, value));

// A 3 x 3 matrix (rows) from an axis times an angle in radians (Rodrigues).
function rotationAbout(turn) {
  const angle = Math.hypot(...turn);
  if (angle < 1e-9) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const [x, y, z] = unit(turn), c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  return [[c + x * x * d, x * y * d - z * s, x * z * d + y * s],
          [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
          [z * x * d - y * s, z * y * d + x * s, c + z * z * d]];
}

// The inverse of rotationAbout, for angles below pi.
function turnOf(m) {
  const c = Math.min(1, Math.max(-1, (m[0][0] + m[1][1] + m[2][2] - 1) / 2));
  const angle = Math.acos(c);
  const axis = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
  return Math.hypot(...axis) < 1e-9 ? [0, 0, 0] : unit(axis).map((value) => value * angle);
}

class ReaderCamera {
  // view: the first view, as view_record of clsplat/report/model_page.py writes it.
  constructor(view) {
    this.view = view;
    this.up = unit(view.up);
    const some = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.north = unit(plus(some, this.up, -dot(some, this.up)));
    this.west = cross(this.up, this.north);
    this.reset();
  }

  // Back to the first view.
  reset() {
    this.lens = 1;
    this.take(this.view);
  }

  // Stand where a camera does. Its horizon may not be level: `tilt` is the turn from the level camera
  // to it, in the camera's axes, and vanishes while the reader moves.
  take({ position, rotation }, distance = this.view.distance) {
    const [, down, forward] = rotation;
    this.distance = distance;
    this.position = [...position];
    const slope = dot(forward, this.up);
    this.pitch = Math.asin(clamped(slope, -1, 1));
    const ahead = plus(forward, down, slope < 0 ? -1 : 1); // not vertical, even straight down
    this.heading = Math.atan2(dot(ahead, this.west), dot(ahead, this.north));
    this.tilt = [0, 0, 0];
    const level = this.axes();
    this.tilt = turnOf(rotation.map((row) => level.map((axis) => dot(row, axis))));
  }

  // All that moves, as numbers. `lens`: by how much larger it shows than the first view.
  get pose() {
    return [...this.position, this.heading, this.pitch, this.distance, ...this.tilt, this.lens];
  }

  set pose([x, y, z, heading, pitch, distance, ...rest]) {
    Object.assign(this, { position: [x, y, z], heading, pitch, distance, tilt: rest.slice(0, 3),
                          lens: rest[3] });
  }

  // Right, down and forward in the world: the rows of the rotation to the camera.
  axes() {
    const { heading, pitch, up, north, west } = this;
    const ahead = plus(north.map((value) => value * Math.cos(heading)), west, Math.sin(heading));
    const forward = plus(ahead.map((value) => value * Math.cos(pitch)), up, Math.sin(pitch));
    const right = cross(ahead, up), level = [right, cross(forward, right), forward];
    return rotationAbout(this.tilt).map((row) => [0, 1, 2].map(
      (axis) => row[0] * level[0][axis] + row[1] * level[1][axis] + row[2] * level[2][axis]));
  }

  centre() { return plus(this.position, this.axes()[2], this.distance); }

  // Look elsewhere, from the same place.
  look(heading, pitch) {
    this.heading += heading;
    this.pitch = clamped(this.pitch + pitch, ...this.view.pitches);
    this.level();
  }

  // Go around the centre.
  orbit(heading, pitch) {
    const centre = this.centre();
    this.look(heading, pitch);
    this.place(plus(centre, this.axes()[2], -this.distance));
  }

  // Nearer by a factor below 1, or away. What lies in a direction, a unit vector, as far away as the
  // centre stays where it is in the picture; without one, the centre itself.
  zoom(factor, ray = this.axes()[2]) {
    const distance = this.limited(this.distance * factor);
    const length = (this.distance - distance) / dot(ray, this.axes()[2]);
    this.distance = distance;
    this.place(plus(this.position, ray, length));
  }

  // Along the camera's axes, world units.
  move(right, down, forward) {
    const axes = this.axes();
    this.place([right, down, forward].reduce(
      (place, length, axis) => plus(place, axes[axis], length), this.position));
  }

  // Upwards in the world.
  rise(length) { this.place(plus(this.position, this.up, length)); }

  // Go to a place, or to the nearest one that is above the ground and near enough to show something.
  place(wanted) {
    const { middle, reach } = this.view;
    const away = plus(wanted, middle, -1), length = Math.hypot(...away);
    const near = length > reach ? plus(middle, away, reach / length) : wanted;
    this.position = plus(near, this.up, Math.max(0, this.view.ground - dot(near, this.up)));
  }

  // Turn towards a point, which becomes the centre.
  lookAt(point) {
    const away = plus(point, this.position, -1);
    this.distance = this.limited(Math.hypot(...away));
    const forward = unit(away), slope = dot(forward, this.up);
    if (Math.abs(slope) < 0.999)
      this.heading = Math.atan2(dot(forward, this.west), dot(forward, this.north));
    this.pitch = clamped(Math.asin(clamped(slope, -1, 1)), ...this.view.pitches);
    this.tilt = [0, 0, 0];
  }

  limited(distance) { return clamped(distance, 0.01 * this.view.distance, this.view.reach); }

  level() { this.tilt = this.tilt.map((value) => 0.9 * value); }

  // A unit vector in the world, from the camera through a place in a picture of width x height.
  ray(x, y, width, height) {
    const { focal, centre, rotation } = this.pinhole(width, height);
    const beam = [(x - centre[0]) / focal[0], (y - centre[1]) / focal[1], 1];
    return unit([0, 1, 2].map((axis) => beam.reduce(
      (sum, along, row) => sum + along * rotation[row][axis], 0)));
  }

  // The camera of a picture of width x height pixels, with the first view's angle: where its shape
  // differs from that of the first view, half of what differs is cropped and half is added.
  pinhole(width, height) {
    const { view } = this;
    const scale = this.lens * Math.sqrt((width / view.width) * (height / view.height));
    return {
      width, height, position: this.position, rotation: this.axes(),
      focal: view.focal.map((value) => value * scale),
      centre: [width / 2 + (view.centre[0] - view.width / 2) * scale,
               height / 2 + (view.centre[1] - view.height / 2) * scale],
    };
  }
  // Where a point of the world is in a picture of width x height, and its depth.
  project(point, width, height) {
    const { focal, centre, rotation } = this.pinhole(width, height);
    const [x, y, depth] = rotation.map((axis) => dot(axis, plus(point, this.position, -1)));
    return [focal[0] * x / depth + centre[0], focal[1] * y / depth + centre[1], depth];
  }
}

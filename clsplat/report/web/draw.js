// Draws the gaussians with WebGL 2: a square each, from back to front.
"use strict";

// Gaussians of an instance: drivers that draw each instance by itself, as those in software do, take
// five times as long for gaussians alone as in bundles.
const BUNDLE = 2048;
const ROW = 4096; // texels of a row of a table
const UNCUT = { axes: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], low: [-1e30, -1e30, -1e30],
                high: [1e30, 1e30, 1e30] };
// of heights, from low to high: viridis, which the colour-blind can read
const PALETTE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const BORDER = 0.15; // of the picture: so far beyond its borders Jacobians are not clamped

// Between which x/z and y/z Jacobians are not clamped: the lowest of both, and the highest.
function ratiosOf({ width, height, focal, centre }) {
  return [-BORDER, 1 + BORDER].flatMap((share) => [width, height].map(
    (length, axis) => (share * length - centre[axis]) / focal[axis]));
}

class Painter {
  // canvas: to draw into; model: the numbers of the page; rows: how many gaussians there may be.
  constructor(canvas, model, rows) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false,
                                             powerPreference: "high-performance" });
    if (!gl) throw new Error(`this browser cannot draw it, as it has no WebGL 2; ${RECENT}`);
    Object.assign(this, { gl, model, drawn: 0 });
    const text = (name) => document.getElementById(name).textContent.trim();
    const defines = ["", `DEGREE ${model.degree}`, `ANTIALIASED ${+model.antialiased}`,
                     `BUNDLE ${BUNDLE}u\n`].join("\n#define ");
    const program = this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, text("vertex").replace("\n", defines)],
                                  [gl.FRAGMENT_SHADER, text("fragment")]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(`its shader was refused (${gl.getShaderInfoLog(shader)})`);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    const texels = texelsOf(model.degree);
    this.tables = {
      places: this.table(0, "places", rows, 4, gl.RGBA32UI, gl.RGBA_INTEGER),
      shapes: this.table(1, "shapes", rows, 2, gl.RG32UI, gl.RG_INTEGER),
      rest: texels && this.table(2, "rest", rows * texels, 4, gl.RGBA32UI, gl.RGBA_INTEGER),
      order: this.table(3, "order", rows, 1, gl.R32UI, gl.RED_INTEGER),
    };
    if (gl.getError() === gl.OUT_OF_MEMORY)
      throw new Error("this device has too little graphics memory for it");
    this.set("near", model.near);
    gl.uniform3fv(this.place("log_scales"), model.logScales.flat());
    gl.uniform3fv(this.place("colours"), model.colours.flat());
    gl.uniform3fv(this.place("reaches"), [...model.harmonics, 0, 0, 0].slice(0, 3));
    const corners = [0, 1, 2, 2, 1, 3];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from(
      { length: 6 * BUNDLE }, (_, k) => 4 * Math.floor(k / 6) + corners[k % 6]), gl.STATIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...model.background, 1);
    this.cut();
    this.target = this.fineTarget();
  }

  // A frame buffer of 16-bit floats, or null where the device draws into none. The canvas has 8
  // bits, to which each of hundreds of faint layers would be rounded: pictures would be too dark.
  fineTarget() {
    const { gl } = this;
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float"))
      return null;
    const target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA16F, 1, 1);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER,
                               gl.getParameter(gl.RENDERBUFFER_BINDING));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE) return target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return null;
  }

  place(name) { return this.gl.getUniformLocation(this.program, name); }

  set(name, ...values) { this.gl[`uniform${values.length}f`](this.place(name), ...values); }

  // A texture of texels of some 32-bit words each, as wide as it may be.
  table(unit, name, texels, words, format, layout) {
    const { gl } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const wide = Math.min(ROW, most), high = Math.ceil(texels / wide);
    if (high > most) throw new Error(`${this.model.count.toLocaleString("en")} gaussians are more `
      + "than this device can draw");
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, wide, high);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.uniform1i(this.place(name), unit);
    return { unit, wide, words, layout };
  }

  // Write words into a table, from a texel on that begins a row.
  write({ unit, wide, words, layout }, content, first = 0) {
    const { gl } = this, row = first / wide, texels = content.length / words;
    const whole = Math.floor(texels / wide), left = texels % wide;
    gl.activeTexture(gl.TEXTURE0 + unit);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, wide, whole, layout, gl.UNSIGNED_INT,
                                content, 0);
    if (left) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row + whole, left, 1, layout, gl.UNSIGNED_INT,
                               content, whole * wide * words);
  }

  // Take unpacked gaussians, the first of which becomes this one, a multiple of ROW.
  fill(first, { places, shapes, rest }) {
    this.write(this.tables.places, places, first);
    this.write(this.tables.shapes, shapes, first);
    if (rest.length) this.write(this.tables.rest, rest, first * texelsOf(this.model.degree));
  }

  // Use another order of the gaussians: those in front of the near plane, from back to front.
  reorder(order) {
    this.write(this.tables.order, order);
    this.drawn = order.length;
  }

  // Keep to gaussians whose centres lie within a box: the rows of its axes, and its limits along
  // each. Nothing: all.
  cut({ axes, low, high } = UNCUT) {
    this.gl.uniformMatrix3fv(this.place("cut_axes"), false, axes.flat());
    this.set("cut_low", ...low);
    this.set("cut_high", ...high);
  }

  // Colour gaussians by their height along `up`, between two, or if there are none, as they are.
  colourByHeight(up, heights) {
    const [low, high] = heights || [0, 0];
    this.set("up", ...up);
    this.set("heights", low, heights ? Math.max(high - low, 1e-6) : 0);
    this.gl.uniform3fv(this.place("palette"), PALETTE.flat().map((byte) => byte / 255));
  }

  draw({ width, height, position, rotation, focal, centre }) {
    const { gl, target } = this;
    if (target && (width !== this.width || height !== this.height)) {
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA16F, width, height);
      Object.assign(this, { width, height });
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(this.place("rotation"), false, rotation.flat());
    this.set("position", ...position);
    this.set("focal", ...focal);
    this.set("centre", ...centre);
    this.set("size", width, height);
    this.set("ratios", ...ratiosOf({ width, height, focal, centre }));
    gl.uniform1ui(this.place("drawn"), this.drawn);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BUNDLE, gl.UNSIGNED_SHORT, 0,
                             Math.ceil(this.drawn / BUNDLE));
    if (!target) return;
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }
}

// Draws the gaussians with WebGL 2: a square each, from back to front.
"use strict";

const BORDER = 0.15; // of the picture: so far beyond its borders Jacobians are not clamped

class Painter {
  // canvas: to draw into; model: the numbers of the page; unpacked: the result of unpack().
  constructor(canvas, model, { places, shapes, rest, texels }) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false,
                                             powerPreference: "high-performance" });
    if (!gl) throw new Error(`this browser cannot draw it, as it has no WebGL 2; ${RECENT}`);
    Object.assign(this, { gl, model, drawn: 0 });
    const text = (name) => document.getElementById(name).textContent.trim();
    const defines = `\n#define DEGREE ${model.degree}\n#define ANTIALIASED ${+model.antialiased}\n`;
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
    this.table(0, "places", places, 4, gl.RGBA32UI, gl.RGBA_INTEGER);
    this.table(1, "shapes", shapes, 2, gl.RG32UI, gl.RG_INTEGER);
    if (texels) this.table(2, "rest", rest, 4, gl.RGBA32UI, gl.RGBA_INTEGER);
    if (gl.getError() === gl.OUT_OF_MEMORY)
      throw new Error("this device has too little graphics memory for it");
    this.set("near", model.near);
    gl.uniform3fv(this.place("log_scales"), model.logScales.flat());
    gl.uniform3fv(this.place("colours"), model.colours.flat());
    gl.uniform3fv(this.place("reaches"), [...model.harmonics, 0, 0, 0].slice(0, 3));
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const attribute = gl.getAttribLocation(program, "gaussian");
    gl.enableVertexAttribArray(attribute);
    gl.vertexAttribIPointer(attribute, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(attribute, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...model.background, 1);
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

  // A texture of `words`, of which a texel has `each`, as wide as it may be.
  table(unit, name, words, each, format, layout) {
    const { gl } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const wide = Math.min(4096, most), high = Math.ceil(words.length / each / wide);
    if (high > most) throw new Error(`${this.model.count.toLocaleString("en")} gaussians are more `
      + "than this device can draw");
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, wide, high);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const whole = Math.floor(words.length / each / wide), row = wide * each;
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, wide, whole, layout, gl.UNSIGNED_INT,
                                words.subarray(0, whole * row));
    if (high > whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, words.length / each % wide, 1,
                                       layout, gl.UNSIGNED_INT, words.subarray(whole * row));
    gl.uniform1i(this.place(name), unit);
  }

  // Use another order of the gaussians: those in front of the near plane, from back to front.
  reorder(order) {
    this.gl.bufferData(this.gl.ARRAY_BUFFER, order, this.gl.STREAM_DRAW);
    this.drawn = order.length;
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
    const size = [width, height];
    this.set("ratios",
      ...size.map((length, axis) => (-BORDER * length - centre[axis]) / focal[axis]),
      ...size.map((length, axis) => ((1 + BORDER) * length - centre[axis]) / focal[axis]));
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    if (!target) return;
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }
}

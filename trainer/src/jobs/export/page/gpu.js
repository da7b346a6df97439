// Draws the Gaussians with WebGL 2: quads, nearest first, into half floats; then over the background. The quads are one
// plain draw of indexed vertices: drivers that draw in software, and some phones, take instances of four one by one.

import { FIXED_TEXELS, FULL, MOVING_TEXELS, PROJECT, RESOLVE, ROW, SPLAT } from "./shaders.js";

const BEHIND = { scene: [0.5, 0.5, 0.5, 1], dark: [0.07, 0.07, 0.09, 1], light: [0.96, 0.96, 0.95, 1], clear: [0, 0, 0, 0] };

export class Gpu {
  constructor(canvas, numbers, info) {
    const gl = canvas.getContext("webgl2", { alpha: true, premultipliedAlpha: true, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser offers no WebGL 2: switch on hardware acceleration, or try another browser");
    Object.assign(this, { gl, canvas, info, size: [0, 0], filter: { lowPass: 0.1, compensated: true } });
    // Colours may leave 0–1 before they are summed: half floats where they can be drawn into, else bytes, a little coarser.
    this.format = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float") ? gl.RGBA16F : gl.RGBA8;
    this.splats = program(gl, PROJECT, SPLAT);
    this.resolve = program(gl, FULL, RESOLVE);
    this.rows = Math.ceil(info.gaussians / ROW);
    this.fixed = texture(gl, FIXED_TEXELS * ROW, this.rows, gl.RGBA32F, padded(fixedNumbers(numbers, info.gaussians), FIXED_TEXELS * 4 * ROW * this.rows));
    this.moving = texture(gl, MOVING_TEXELS * ROW, this.rows, gl.RGBA32F, null);
    this.staging = new Float32Array(MOVING_TEXELS * 4 * ROW * this.rows);
    this.order = texture(gl, ROW, this.rows, gl.R32UI, null);
    this.turns = new Uint32Array(ROW * this.rows);
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from({ length: 6 * info.gaussians }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]), gl.STATIC_DRAW);
    this.empty = gl.createVertexArray();
    this.target = gl.createFramebuffer();
    this.plate = null;
  }

  setPlate(image) {
    const { gl } = this;
    this.plate = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.plate);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, way, gl.LINEAR);
  }

  setMoving(numbers) {
    const { gl } = this;
    this.staging.set(numbers);
    gl.bindTexture(gl.TEXTURE_2D, this.moving);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, MOVING_TEXELS * ROW, this.rows, gl.RGBA, gl.FLOAT, this.staging);
  }

  // `order`: slots, nearest first. `background`: scene, dark, light, clear; all but the scene show the head alone.
  draw(view, order, background) {
    const { gl, canvas } = this;
    this.resize(view.width, view.height);
    this.turns.set(order);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, this.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, this.turns);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, view.width, view.height);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.useProgram(this.splats);
    this.bind(this.splats, { u_fixed: this.fixed, u_moving: this.moving, u_order: this.order });
    const set = (name) => gl.getUniformLocation(this.splats, name);
    gl.uniformMatrix3fv(set("u_rotation"), true, view.rotation);
    gl.uniform3fv(set("u_translation"), view.translation);
    gl.uniform3fv(set("u_eye"), view.eye);
    gl.uniform2f(set("u_size"), view.width, view.height);
    gl.uniform2fv(set("u_focal"), view.focal);
    gl.uniform2fv(set("u_middle"), view.middle);
    gl.uniform1f(set("u_skew"), view.skew);
    gl.uniform1f(set("u_largest_r2"), view.largestR2);
    gl.uniform1f(set("u_low_pass"), this.filter.lowPass);
    gl.uniform1f(set("u_compensated"), this.filter.compensated ? 1 : 0);
    gl.uniform1f(set("u_head_only"), background === "scene" ? 0 : 1);
    gl.uniform4fv(set("u_limits"), view.limits);
    gl.uniform1i(set("u_bent"), view.distortion ? 1 : 0);
    gl.uniform1fv(set("u_lens"), view.distortion ?? new Array(8).fill(0));
    gl.bindVertexArray(this.quads);
    gl.drawElements(gl.TRIANGLES, 6 * order.length, gl.UNSIGNED_INT, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.resolve);
    const withPlate = background === "scene" && this.plate;
    this.bind(this.resolve, { u_color: this.color, u_shown: this.shown, u_plate: withPlate ? this.plate : this.color });
    const put = (name) => gl.getUniformLocation(this.resolve, name);
    gl.uniform2f(put("u_size"), canvas.width, canvas.height);
    gl.uniform4fv(put("u_behind"), BEHIND[background]);
    gl.uniform4fv(put("u_frame"), view.frame);
    gl.uniform1i(put("u_has_plate"), withPlate ? 1 : 0);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  bind(of, textures) {
    const { gl } = this;
    Object.entries(textures).forEach(([name, one], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, one);
      gl.uniform1i(gl.getUniformLocation(of, name), unit);
    });
  }

  resize(width, height) {
    const { gl, canvas } = this;
    if (this.size[0] === width && this.size[1] === height) return;
    this.size = [width, height];
    Object.assign(canvas, { width, height });
    for (const old of [this.color, this.shown]) if (old) gl.deleteTexture(old);
    [this.color, this.shown] = [0, 1].map(() => texture(gl, width, height, this.format, null));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.color, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT1, gl.TEXTURE_2D, this.shown, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) throw new Error("this graphics driver cannot draw into two half-float textures");
  }
}

// What does not move: rotation · scale, opacity, head weight, harmonics.
function fixedNumbers({ quaternion, log_scale, opacity, head, sh1 }, count) {
  const out = new Float32Array(FIXED_TEXELS * 4 * count);
  for (let i = 0; i < count; i += 1) {
    const q = quaternion.subarray(4 * i, 4 * i + 4), length = Math.hypot(...q), [w, x, y, z] = q.map((v) => v / length);
    const columns = [[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]];
    const at = FIXED_TEXELS * 4 * i;
    columns.forEach((column, k) => { const s = Math.exp(log_scale[3 * i + k]); column.forEach((v, r) => { out[at + 4 * k + r] = v * s; }); });
    out[at + 3] = 1 / (1 + Math.exp(-opacity[i]));
    out[at + 7] = head[i];
    for (let b = 0; b < 3; b += 1) for (let c = 0; c < 3; c += 1) out[at + 12 + 4 * b + c] = sh1[9 * i + 3 * b + c];
  }
  return out;
}

function padded(numbers, length) {
  const out = new Float32Array(length);
  out.set(numbers);
  return out;
}

function texture(gl, width, height, format, numbers) {
  const one = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, one);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, way, gl.NEAREST);
  if (numbers) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT, numbers);
  return one;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(`the shaders do not link: ${gl.getProgramInfoLog(made)}`);
  return made;
}

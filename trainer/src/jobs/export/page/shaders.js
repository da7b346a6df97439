// The shaders: EWA splatting with an antialiasing low-pass and compensated opacity (Mip-Splatting), as in trainer/splat.

// A Gaussian's texels: columns of rotation · scale with opacity, head weight, 0; harmonics y, z, x. Then mean; colour.
export const FIXED_TEXELS = 6, MOVING_TEXELS = 2, ROW = 256;

export const PROJECT = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D u_fixed, u_moving;
uniform highp usampler2D u_order;
uniform mat3 u_rotation;
uniform vec3 u_translation, u_eye;
uniform vec2 u_size, u_focal, u_middle;
uniform float u_skew, u_largest_r2, u_low_pass, u_compensated, u_head_only;
uniform vec4 u_limits;
uniform bool u_bent;
uniform float u_lens[8];
flat out vec2 v_middle;
flat out vec4 v_conic;
flat out vec4 v_color;
const float SH_C1 = 0.48860251, LEAST_RATIO = 1e-5, MOST_OPACITY = 0.99, NEAR = 0.01;

void lens(vec2 p, out vec2 at, out mat2 slope) {
  float r2 = dot(p, p), xy = p.x * p.y;
  float up = 1.0 + r2 * (u_lens[0] + r2 * (u_lens[1] + r2 * u_lens[2]));
  float down = 1.0 + r2 * (u_lens[3] + r2 * (u_lens[4] + r2 * u_lens[5]));
  float d = up / down;
  float dup = u_lens[0] + r2 * (2.0 * u_lens[1] + r2 * 3.0 * u_lens[2]);
  float ddown = u_lens[3] + r2 * (2.0 * u_lens[4] + r2 * 3.0 * u_lens[5]);
  float dd = 2.0 * (dup - d * ddown) / down;
  float p1 = u_lens[6], p2 = u_lens[7];
  at = vec2(p.x * d + 2.0 * p1 * xy + p2 * (r2 + 2.0 * p.x * p.x), p.y * d + 2.0 * p2 * xy + p1 * (r2 + 2.0 * p.y * p.y));
  float across = xy * dd + 2.0 * p1 * p.x + 2.0 * p2 * p.y;
  // Columns: by x, by y.
  slope = mat2(d + p.x * p.x * dd + 2.0 * p1 * p.y + 6.0 * p2 * p.x, across, across, d + p.y * p.y * dd + 2.0 * p2 * p.x + 6.0 * p1 * p.y);
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  v_middle = vec2(0.0); v_conic = vec4(0.0); v_color = vec4(0.0);
  // Four vertices a Gaussian; which one, the order tells.
  int turn = gl_VertexID >> 2, slot = int(texelFetch(u_order, ivec2(turn % ${ROW}, turn / ${ROW}), 0).r);
  ivec2 place = ivec2(slot % ${ROW}, slot / ${ROW});
  ivec2 f = ivec2(place.x * ${FIXED_TEXELS}, place.y), m = ivec2(place.x * ${MOVING_TEXELS}, place.y);
  vec4 m0 = texelFetch(u_fixed, f, 0), m1 = texelFetch(u_fixed, f + ivec2(1, 0), 0), m2 = texelFetch(u_fixed, f + ivec2(2, 0), 0);
  vec3 mean = texelFetch(u_moving, m, 0).xyz;
  vec3 t = u_rotation * mean + u_translation;
  if (t.z <= NEAR) return;
  vec2 p = t.xy / t.z, at = p;
  mat2 slope = mat2(1.0);
  if (u_bent) {
    if (dot(p, p) >= u_largest_r2) return;
    lens(p, at, slope);
  }
  vec2 middle = vec2(u_focal.x * at.x + u_skew * at.y, u_focal.y * at.y) + u_middle;
  // Rows of ∂(u, v)/∂(x/z, y/z).
  vec2 j0 = u_focal.x * vec2(slope[0].x, slope[1].x) + u_skew * vec2(slope[0].y, slope[1].y);
  vec2 j1 = u_focal.y * vec2(slope[0].y, slope[1].y);
  p = clamp(p, u_limits.xz, u_limits.yw);
  mat3 rows = transpose(u_rotation);
  vec3 n0 = (rows[0] - p.x * rows[2]) / t.z, n1 = (rows[1] - p.y * rows[2]) / t.z;
  vec3 t0 = j0.x * n0 + j0.y * n1, t1 = j1.x * n0 + j1.y * n1;
  vec3 p0 = vec3(dot(t0, m0.xyz), dot(t0, m1.xyz), dot(t0, m2.xyz));
  vec3 p1 = vec3(dot(t1, m0.xyz), dot(t1, m1.xyz), dot(t1, m2.xyz));
  float a = dot(p0, p0) + u_low_pass, b = dot(p0, p1), c = dot(p1, p1) + u_low_pass;
  // det(p pᵀ) as a sum of squared minors: no cancellation for needles.
  vec3 minors = cross(p0, p1);
  float det0 = dot(minors, minors), det = u_low_pass * (a + c - u_low_pass) + det0;
  float ratio = max(det0 / det, LEAST_RATIO);
  float opacity = min(m0.w * mix(1.0, sqrt(ratio), u_compensated), MOST_OPACITY);
  float level = 2.0 * log(255.0 * opacity);
  if (!(level > 0.0)) return;
  vec2 half_size = sqrt(level * vec2(a, c));
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1 & 1)) * 2.0 - 1.0;
  vec3 d = normalize(mean - u_eye);
  vec3 color = texelFetch(u_moving, m + ivec2(1, 0), 0).rgb + SH_C1 * (
    -d.y * texelFetch(u_fixed, f + ivec2(3, 0), 0).rgb + d.z * texelFetch(u_fixed, f + ivec2(4, 0), 0).rgb - d.x * texelFetch(u_fixed, f + ivec2(5, 0), 0).rgb);
  v_middle = middle;
  v_conic = vec4(c / det, -b / det, a / det, opacity);
  v_color = vec4(color, mix(1.0, m1.w, u_head_only));
  // Rows of the target run downwards, as the picture's.
  gl_Position = vec4((middle + corner * (half_size + 1.0)) / u_size * 2.0 - 1.0, 0.0, 1.0);
}`;

// Front to back: what a target takes is weighted by what its alpha leaves. Both alphas hold the whole opacity, the second
// target's red that of what is shown.
export const SPLAT = `#version 300 es
precision highp float;
flat in vec2 v_middle;
flat in vec4 v_conic;
flat in vec4 v_color;
layout(location = 0) out vec4 o_color;
layout(location = 1) out vec4 o_shown;

void main() {
  vec2 d = gl_FragCoord.xy - v_middle;
  float alpha = v_conic.w * exp(-0.5 * (v_conic.x * d.x * d.x + v_conic.z * d.y * d.y) - v_conic.y * d.x * d.y);
  if (alpha < 1.0 / 255.0) discard;
  float shown = alpha * v_color.a;
  o_color = vec4(shown * v_color.rgb, alpha);
  o_shown = vec4(shown, 0.0, 0.0, alpha);
}`;

export const FULL = `#version 300 es
void main() { gl_Position = vec4(float(gl_VertexID & 1) * 4.0 - 1.0, float(gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// Lays the Gaussians over what is behind them; premultiplied.
export const RESOLVE = `#version 300 es
precision highp float;
uniform highp sampler2D u_color, u_shown, u_plate;
uniform vec2 u_size;
uniform vec4 u_behind, u_frame;
uniform bool u_has_plate;
out vec4 o_color;

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, u_size.y - gl_FragCoord.y);
  ivec2 at = ivec2(pixel);
  vec3 color = texelFetch(u_color, at, 0).rgb;
  float shown = texelFetch(u_shown, at, 0).r;
  vec4 behind = u_behind;
  if (u_has_plate) behind = vec4(texture(u_plate, (pixel - u_frame.xy) / u_frame.zw).rgb, 1.0);
  vec4 result = vec4(color + (1.0 - shown) * behind.rgb * behind.a, shown + (1.0 - shown) * behind.a);
  o_color = vec4(clamp(result.rgb, 0.0, result.a), result.a);
}`;

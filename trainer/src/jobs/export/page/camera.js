// A camera told by angles around the head, as `trainer render` has it: lengths in metres, x right, y down, z forward.

export const HOME = { yaw_deg: 0, pitch_deg: 0, zoom: 1, shift_x: 0, shift_y: 0 };
const clamp = (v, low, high) => Math.min(high, Math.max(low, v));
// How far beyond the picture the projection's slope is followed, in half fields of view.
const BEYOND = 1.3;

export function bounded(o) {
  return { yaw_deg: clamp(o.yaw_deg, -180, 180), pitch_deg: clamp(o.pitch_deg, -80, 80), zoom: clamp(o.zoom, 0.2, 10), shift_x: clamp(o.shift_x, -1, 1), shift_y: clamp(o.shift_y, -1, 1) };
}

const times = (m, v) => [0, 3, 6].map((r) => m[r] * v[0] + m[r + 1] * v[1] + m[r + 2] * v[2]);

function product(a, b) {
  const out = [];
  for (let r = 0; r < 3; r += 1) for (let c = 0; c < 3; c += 1) out.push(a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c]);
  return out;
}

// OpenCV's lens: (x/z, y/z) to the distorted ones.
export function distorted([x, y], d) {
  if (!d) return [x, y];
  const [k1, k2, k3, k4, k5, k6, p1, p2] = d, r2 = x * x + y * y;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)];
}

function undistorted(point, d) {
  let [x, y] = point;
  for (let i = 0; i < 30; i += 1) {
    const [u, v] = distorted([x, y], d);
    x += point[0] - u;
    y += point[1] - v;
  }
  const [u, v] = distorted([x, y], d);
  return Math.hypot(u - point[0], v - point[1]) < 1e-6 ? [x, y] : null;
}

// The squared radius up to which a lens is followed: a little beyond the corners, and not beyond its fold.
function largestR2(camera) {
  if (!camera.distortion) return 1e30;
  const { width, height, focal, middle, skew, distortion } = camera;
  let farthest = 0;
  for (const [u, v] of [[0, 0], [width, 0], [0, height], [width, height]]) {
    const y = (v - middle[1]) / focal[1], at = undistorted([(u - middle[0] - skew * y) / focal[0], y], distortion);
    farthest = Math.max(farthest, at ? Math.hypot(...at) : 3);
  }
  farthest = Math.min(farthest, 3);
  const step = (Math.max(farthest, 0.1) * 1.2) / 64, rise = (r) => Math.hypot(...distorted([r, 0], distortion));
  let r = 0;
  while (r < farthest * 1.2 && rise(r + step) - rise(r) > 0.2 * step) r += step;
  return r * r;
}

// The view of `orbit` in a picture of `width` × `height` that the avatar's own picture fits into.
export function viewOf(reference, orbit, width, height) {
  const { rotation: r, translation: t, center } = reference;
  const [yaw, pitch] = [orbit.yaw_deg, orbit.pitch_deg].map((a) => (a * Math.PI) / 180);
  const [cy, sy, cx, sx] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const turn = product([1, 0, 0, 0, cx, -sx, 0, sx, cx], [cy, 0, sy, 0, 1, 0, -sy, 0, cy]);
  const arm = times(r, center), turned = times(turn, arm);
  const head = arm.map((v, i) => v + t[i]);
  const at = distorted([head[0] / head[2], head[1] / head[2]], reference.distortion);
  const middle = [reference.focal[0] * at[0] + reference.skew * at[1] + reference.middle[0], reference.focal[1] * at[1] + reference.middle[1]];
  const scale = Math.min(width / reference.width, height / reference.height);
  const size = [width, height], own = [reference.width, reference.height], shift = [orbit.shift_x, orbit.shift_y];
  const view = {
    width, height, distortion: reference.distortion,
    rotation: product(turn, r),
    translation: head.map((v, i) => v - turned[i]),
    focal: reference.focal.map((f) => f * orbit.zoom * scale),
    skew: reference.skew * scale,
    middle: middle.map((m, i) => (m + (reference.middle[i] - m) * orbit.zoom + shift[i] * own[i]) * scale + (size[i] - own[i] * scale) / 2),
    // Where the avatar's own picture lies in this one: left, top, width, height.
    frame: [(width - own[0] * scale) / 2, (height - own[1] * scale) / 2, own[0] * scale, own[1] * scale],
  };
  view.limits = [0, 1].flatMap((i) => {
    const low = -view.middle[i] / view.focal[i], high = (size[i] - view.middle[i]) / view.focal[i], half = (Math.abs(high - low) / 2) * BEYOND;
    return [(low + high) / 2 - half, (low + high) / 2 + half];
  });
  // The camera's own place: −Rᵀ t.
  view.eye = [0, 1, 2].map((c) => -(view.rotation[c] * view.translation[0] + view.rotation[3 + c] * view.translation[1] + view.rotation[6 + c] * view.translation[2]));
  view.largestR2 = largestR2(view);
  return view;
}

// AU intensities → activations → means and colours of all Gaussians, and their order by depth.
//
//   θ(a) = θ0 + Σ_k a_k Δθ_k        gates are part of Δ; activations up to LEAST count as 0

const LANES = 16, CHANNELS = 6, LEAST = 0.02;
// Floats of a Gaussian in `moving`: x y z 0, red green blue 0.
const STRIDE = 8;

// The activations of the AUs that move the avatar; `aus` holds intensities by unit, those left out are neutral.
export function activationsOf(info, aus) {
  return info.moving.map((k) => {
    const { unit, neutral } = info.aus[k], { least, most, width } = info.scales[k];
    const asked = Number.isFinite(aus[unit]) ? aus[unit] : neutral;
    const a = (Math.max(Math.min(asked, most), least) - least) / width;
    const capped = info.intensities ? a : Math.min(a, 1);
    return capped > LEAST ? capped : 0;
  });
}

export class Blender {
  constructor(numbers, info) {
    Object.assign(this, { numbers, info });
    this.moving = new Float32Array(STRIDE * info.gaussians);
    this.rest = new Float32Array(STRIDE * info.gaussians);
    const { mean, color } = numbers;
    for (let i = 0; i < info.gaussians; i += 1)
      for (let c = 0; c < 3; c += 1) {
        this.rest[STRIDE * i + c] = mean[3 * i + c];
        this.rest[STRIDE * i + 4 + c] = color[3 * i + c];
      }
    this.now = null;
  }

  // Brings `moving` to an expression; false where it is there already.
  blend(aus) {
    const activations = activationsOf(this.info, aus), signature = activations.join();
    if (signature === this.now) return false;
    this.now = signature;
    const { moving, numbers: { deltas, delta_scales: scales } } = this;
    moving.set(this.rest);
    const blocks = Math.ceil(this.info.deformable / LANES);
    activations.forEach((activation, at) => {
      if (activation === 0) return;
      for (let b = 0; b < blocks; b += 1)
        for (let kind = 0; kind < 2; kind += 1) {
          const by = activation * scales[2 * (at * blocks + b) + kind];
          if (by === 0) continue;
          const lanes = Math.min(LANES, this.info.deformable - b * LANES);
          for (let c = 0; c < 3; c += 1) {
            const from = ((at * blocks + b) * CHANNELS + 3 * kind + c) * LANES, to = STRIDE * b * LANES + 4 * kind + c;
            for (let i = 0; i < lanes; i += 1) moving[to + STRIDE * i] += by * deltas[from + i];
          }
        }
    });
    return true;
  }
}

// Counting sort by depth, nearest first; equal depths stay in the Gaussians' order. Of the head alone (`heads`: its
// weights), what lies behind its last Gaussian is left out: nothing of it would be seen.
export class Sorter {
  constructor(count) {
    this.count = count;
    this.order = new Uint32Array(count);
    this.keys = new Uint16Array(count);
    this.depths = new Float32Array(count);
    this.starts = new Uint32Array(65537);
  }

  sort(moving, rotation, translation, heads = null) {
    const { count, depths, keys, starts, order } = this, [x, y, z] = rotation.slice(6), t = translation[2];
    let near = Infinity, far = -Infinity;
    for (let i = 0, j = 0; i < count; i += 1, j += STRIDE) {
      const depth = x * moving[j] + y * moving[j + 1] + z * moving[j + 2] + t;
      depths[i] = depth;
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
    // Reciprocal depth: fine where things are near, whatever is far behind.
    near = Math.max(near, 0.01);
    const range = 1 / near - 1 / Math.max(far, near), scale = range > 0 ? 65535 / range : 0;
    starts.fill(0);
    for (let i = 0; i < count; i += 1) {
      const key = (1 / near - 1 / Math.max(depths[i], near)) * scale;
      keys[i] = key;
      starts[keys[i] + 1] += 1;
    }
    for (let k = 0; k < 65536; k += 1) starts[k + 1] += starts[k];
    for (let i = 0; i < count; i += 1) order[starts[keys[i]]++] = i;
    let shown = count;
    while (heads && shown > 0 && heads[order[shown - 1]] === 0) shown -= 1;
    return order.subarray(0, shown);
  }
}

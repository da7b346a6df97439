// Plays AU curves and camera paths by the clock: a slow machine shows fewer pictures, not a slower face.

// Every AU in turn, up and down, for those that ever moved.
export function sweep(aus) {
  const units = aus.filter((a) => a.active).map((a) => a.unit);
  const times = [], rows = [];
  for (let i = 0; i < units.length; i += 1)
    for (let s = 0; s < 30; s += 1) {
      times.push((i * 30 + s) / 25);
      const top = aus.find((a) => a.unit === units[i]).max;
      rows.push(units.map((_, k) => (k === i ? top * (0.5 - 0.5 * Math.cos((2 * Math.PI * s) / 30)) : 0)));
    }
  return { name: "each AU in turn", units, times_secs: times, rows };
}

export function lengthOf(curve) {
  return curve.times_secs[curve.times_secs.length - 1] - curve.times_secs[0];
}

// The expression of a curve at `secs` from its start; values that are missing hold the last known one.
export function expressionAt(curve, secs) {
  const t = secs + curve.times_secs[0], times = curve.times_secs;
  let low = 0, high = times.length - 1;
  while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= t) low = middle; else high = middle - 1; }
  const next = Math.min(low + 1, times.length - 1);
  const share = next > low ? Math.min(1, Math.max(0, (t - times[low]) / (times[next] - times[low]))) : 0;
  const known = (row, k) => { for (; row >= 0; row -= 1) if (curve.rows[row][k] !== null) return curve.rows[row][k]; return 0; };
  const aus = {};
  curve.units.forEach((unit, k) => { const a = known(low, k), b = known(next, k); aus[unit] = a + (b - a) * share; });
  return aus;
}

// Keys joined by smooth steps, for a look at the path; `trainer render --path` draws its own, smoother curve.
export function momentAt(keys, secs) {
  if (secs <= keys[0].secs) return keys[0];
  for (let i = 1; i < keys.length; i += 1) {
    if (secs > keys[i].secs) continue;
    const a = keys[i - 1], b = keys[i], t = (secs - a.secs) / (b.secs - a.secs), s = t * t * (3 - 2 * t);
    const mix = (x, y) => x + (y - x) * s, orbit = {}, aus = {};
    for (const k of Object.keys(a.orbit)) orbit[k] = mix(a.orbit[k], b.orbit[k]);
    for (const u of new Set([...Object.keys(a.aus), ...Object.keys(b.aus)])) aus[u] = mix(a.aus[u] ?? 0, b.aus[u] ?? 0);
    return { orbit, aus };
  }
  return keys[keys.length - 1];
}

export class Player {
  constructor(step, ended) { Object.assign(this, { step, ended, length: 0, at: 0, playing: null }); }

  start(what, length) {
    this.stop();
    Object.assign(this, { playing: what, length, at: this.at >= length ? 0 : this.at, last: performance.now() });
    const tick = () => {
      if (!this.playing) return;
      const now = performance.now();
      this.at += (now - this.last) / 1000;
      this.last = now;
      if (this.at >= this.length) { if (this.playing === "path") { this.at = this.length; this.step(this.playing, this.at); return this.stop(); } this.at %= this.length; }
      this.step(this.playing, this.at);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  stop() { const was = this.playing; this.playing = null; if (was) this.ended(was); }
}

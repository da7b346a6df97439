// Mouse, pen and fingers on the picture: one turns, two (or with Shift, or the middle button) shift and zoom.

export function followGestures(stage, orbit, turn, home) {
  const held = new Map();
  const middle = () => {
    const all = [...held.values()], n = all.length;
    const x = all.reduce((s, p) => s + p.x, 0) / n, y = all.reduce((s, p) => s + p.y, 0) / n;
    return { x, y, spread: n > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  stage.addEventListener("pointerdown", (e) => {
    if (e.target.closest("#trouble")) return;
    held.set(e.pointerId, { x: e.clientX, y: e.clientY, shift: e.shiftKey || e.button === 1 });
    stage.setPointerCapture(e.pointerId);
    stage.classList.add("turning");
  });
  stage.addEventListener("pointermove", (e) => {
    const one = held.get(e.pointerId);
    if (!one) return;
    const before = middle();
    Object.assign(one, { x: e.clientX, y: e.clientY });
    const now = middle(), dx = now.x - before.x, dy = now.y - before.y, o = orbit();
    if (held.size > 1 || one.shift) {
      const zoom = before.spread > 0 && now.spread > 0 ? o.zoom * (now.spread / before.spread) : o.zoom;
      turn({ shift_x: o.shift_x + dx / stage.clientWidth, shift_y: o.shift_y + dy / stage.clientHeight, zoom });
    } else {
      turn({ yaw_deg: o.yaw_deg + (dx * 0.25) / o.zoom, pitch_deg: o.pitch_deg - (dy * 0.25) / o.zoom });
    }
  });
  for (const end of ["pointerup", "pointercancel"])
    stage.addEventListener(end, (e) => { held.delete(e.pointerId); if (!held.size) stage.classList.remove("turning"); });
  stage.addEventListener("wheel", (e) => { e.preventDefault(); turn({ zoom: orbit().zoom * Math.exp(-e.deltaY * 0.0015) }); }, { passive: false });
  stage.addEventListener("dblclick", home);
}

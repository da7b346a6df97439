// Ties controls, pictures and keys together.

import { Picture } from "./picture.js";
import { Player, expressionAt, lengthOf, momentAt, sweep } from "./player.js";
import { make, makeLegend, makePresets, makeSliders, presetAus } from "./panel.js";

const $ = (id) => document.getElementById(id);
for (const event of ["pointerdown", "keydown"]) addEventListener(event, () => { if ($("trouble").dataset.lasting) { delete $("trouble").dataset.lasting; $("trouble").hidden = true; } }, true);
const HOME = { yaw_deg: 0, pitch_deg: 0, zoom: 1, shift_x: 0, shift_y: 0 };
const state = { orbit: { ...HOME }, aus: {}, before: {}, overlay: "none", compare: false, divider: 0.5, jpeg: false, live: false, liveHead: false };
const clamp = (v, low, high) => Math.min(high, Math.max(low, v));

const info = await (await fetch("info.json")).json();
document.title = `${info.name} · Risorius`;
$("name").textContent = info.name;

let heard = 0;
const show = {
  meter(fps, { millis, width, height }) {
    $("fps").textContent = fps >= 10 ? fps.toFixed(0) : fps.toFixed(1);
    $("millis").textContent = millis.toFixed(0);
    $("size").textContent = `${width}×${height}`;
  },
  rest() { $("fps").textContent = "0"; },
  // What goes wrong with pictures is over with the next picture; anything else stands until it is clicked or something is done.
  trouble(text, lasting = false) {
    if (!text && $("trouble").dataset.lasting) return;
    $("trouble").hidden = !text;
    $("trouble").textContent = text;
    if (lasting) $("trouble").dataset.lasting = "yes"; else delete $("trouble").dataset.lasting;
  },
  say(text) { $("status").textContent = text; },
  // What the live face did in the picture that came, and how it goes.
  live(driven) {
    if (!driven || !state.live) return;
    const { aus, status } = driven;
    state.aus = aus;
    for (const [unit, slider] of sliders) slider.show(aus[unit] ?? 0);
    $("live-status").textContent = status.ended ? "ended" : status.problem ?? (!status.rows ? "waits for rows" : status.face ? `${status.rows} rows` : "no face");
    if (status.ended) return follow(false);
    const next = () => picture.change(state.liveHead ? "turn" : "edit");
    // Without a new row there is nothing new to see.
    if (status.rows === heard) setTimeout(next, 60); else next();
    heard = status.rows;
  },
};
const picture = new Picture($("picture"), info, state, show);
// For tests and for scripts in the console.
window.risorius = { state, picture, info };

// Expressions
const sliders = makeSliders($("aus"), info, (unit, value) => { player.stop(); follow(false); state.aus = { ...state.aus, [unit]: value }; picture.change("edit"); });
function wear(aus, how) {
  state.aus = { ...aus };
  for (const [unit, slider] of sliders) slider.show(aus[unit] ?? 0);
  picture.change(how);
}
const choose = (preset) => { player.stop(); follow(false); wear(presetAus(preset)); show.say(preset.name); };
makePresets($("presets"), info.presets, choose);
makeLegend($("legend"), info.regions);

// Camera
function turn(change) {
  const o = state.orbit = { ...state.orbit, ...change };
  o.yaw_deg = clamp(o.yaw_deg, -180, 180); o.pitch_deg = clamp(o.pitch_deg, -80, 80); o.zoom = clamp(o.zoom, 0.3, 8);
  o.shift_x = clamp(o.shift_x, -1, 1); o.shift_y = clamp(o.shift_y, -1, 1);
  $("unseen").hidden = Math.abs(o.yaw_deg) <= info.seen_deg[0] * 1.15 && Math.abs(o.pitch_deg) <= info.seen_deg[1] * 1.15;
  picture.change("turn");
}
const stage = $("stage");
let drag = null;
stage.addEventListener("pointerdown", (e) => {
  if (e.target.closest("#divider")) return;
  drag = { x: e.clientX, y: e.clientY, shift: e.shiftKey || e.button === 1 };
  stage.setPointerCapture(e.pointerId);
  stage.classList.add("turning");
  player.stop();
});
stage.addEventListener("pointermove", (e) => {
  if (!drag) return;
  const dx = e.clientX - drag.x, dy = e.clientY - drag.y, o = state.orbit;
  Object.assign(drag, { x: e.clientX, y: e.clientY });
  if (drag.shift) turn({ shift_x: o.shift_x + dx / stage.clientWidth, shift_y: o.shift_y + dy / stage.clientHeight });
  else turn({ yaw_deg: o.yaw_deg + dx * 0.25 / o.zoom, pitch_deg: o.pitch_deg - dy * 0.25 / o.zoom });
});
for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => { drag = null; stage.classList.remove("turning"); });
stage.addEventListener("wheel", (e) => { e.preventDefault(); turn({ zoom: state.orbit.zoom * Math.exp(-e.deltaY * 0.0015) }); }, { passive: false });
stage.addEventListener("dblclick", () => turn(HOME));

// Before and after
function place(divider) {
  state.divider = clamp(divider, 0, 1);
  const stageBox = stage.getBoundingClientRect(), c = $("picture");
  const shown = Math.min(stageBox.width, stageBox.height * (c.width / c.height));
  $("divider").style.left = `${(stageBox.width - shown) / 2 + state.divider * shown}px`;
  $("divider").setAttribute("aria-valuenow", Math.round(state.divider * 100));
  picture.repaint();
}
function compare(on) { state.compare = $("compare").checked = on; $("divider").hidden = !on; place(state.divider); picture.change(); show.say(on ? "before and after" : "after only"); }
$("compare").addEventListener("change", () => compare($("compare").checked));
$("keep-before").addEventListener("click", () => { state.before = { ...state.aus }; compare(true); });
$("divider").addEventListener("pointerdown", (e) => { e.stopPropagation(); $("divider").setPointerCapture(e.pointerId); });
$("divider").addEventListener("pointermove", (e) => {
  if (!$("divider").hasPointerCapture(e.pointerId)) return;
  const box = stage.getBoundingClientRect(), c = $("picture"), shown = Math.min(box.width, box.height * (c.width / c.height));
  place((e.clientX - box.left - (box.width - shown) / 2) / shown);
});
addEventListener("resize", () => place(state.divider));

// Overlays
function overlay(value) {
  state.overlay = value;
  document.querySelector(`input[name=overlay][value=${value}]`).checked = true;
  $("legend").hidden = value !== "masks";
  picture.change();
  show.say(value === "none" ? "picture" : value);
}
for (const radio of document.querySelectorAll("input[name=overlay]")) radio.addEventListener("change", () => overlay(radio.value));
$("jpeg").addEventListener("change", () => { state.jpeg = $("jpeg").checked; picture.change(); });

// Curves
const curves = [sweep(info.aus)];
function offer(curve) { curves.push(curve); $("curve").append(make("option", { textContent: curve.name, value: curves.length - 1 })); $("curve").value = curves.length - 1; player.at = 0; }
$("curve").append(make("option", { textContent: curves[0].name, value: 0 }));
const keys = [];
const player = new Player((what, at) => {
  if (what === "path") { const m = momentAt(keys, at); wear(m.aus, "edit"); turn(m.orbit); return; }
  const curve = curves[$("curve").value];
  wear(expressionAt(curve, at), "edit");
  $("seek").value = (1000 * at) / lengthOf(curve);
}, (was) => {
  const button = was === "path" ? $("play-path") : $("play");
  button.textContent = "play"; button.setAttribute("aria-pressed", "false"); picture.change();
});
function play(what) {
  if (player.playing === what) return player.stop();
  follow(false);
  if (player.playing !== what && what === "path") player.at = 0;
  player.start(what, what === "path" ? keys[keys.length - 1].secs : lengthOf(curves[$("curve").value]));
  const button = what === "path" ? $("play-path") : $("play");
  button.textContent = "stop"; button.setAttribute("aria-pressed", "true");
}
$("play").addEventListener("click", () => play("curve"));
$("curve").addEventListener("change", () => { player.at = 0; $("seek").value = 0; });
$("seek").addEventListener("input", () => { player.stop(); follow(false); const c = curves[$("curve").value]; player.at = ($("seek").value / 1000) * lengthOf(c); wear(expressionAt(c, player.at), "edit"); });
$("curve-file").addEventListener("change", async () => {
  const file = $("curve-file").files[0];
  if (!file) return;
  const answer = await fetch("curves", { method: "POST", body: file });
  if (!answer.ok) return show.trouble(`${file.name}: ${await answer.text()}`, true);
  offer({ ...(await answer.json()), name: file.name });
  show.say(`${file.name} opened`);
});
if (info.curves) offer(info.curves);

// A live face
function follow(on) {
  if (!info.live || on === state.live) return;
  if (on) player.stop();
  state.live = on;
  $("live").setAttribute("aria-pressed", String(on));
  $("live").textContent = on ? "stop following" : "follow live face";
  picture.change(on ? "edit" : undefined);
  show.say(on ? "follows the live face" : "no longer follows");
}
function followHead(on) { state.liveHead = $("live-head").checked = on; picture.change("turn"); show.say(on ? "follows its head" : "holds the head"); }
$("live-row").hidden = !info.live;
$("live").addEventListener("click", () => follow(!state.live));
$("live-head").addEventListener("change", () => followHead($("live-head").checked));

// Paths
function keep() {
  const secs = keys.length ? keys[keys.length - 1].secs + 2 : 0;
  keys.push({ secs, orbit: { ...state.orbit }, aus: Object.fromEntries(Object.entries(state.aus).filter(([, v]) => v > 0)) });
  pathChanged();
  show.say(`moment ${keys.length} kept`);
}
function pathChanged(text) {
  $("keys").textContent = text ?? (keys.length ? `${keys.length} moments, ${keys[keys.length - 1].secs} s` : "no moments kept");
  $("play-path").disabled = $("save-path").disabled = keys.length < 2;
  $("clear-path").disabled = !keys.length;
}
$("key").addEventListener("click", keep);
$("play-path").addEventListener("click", () => play("path"));
$("clear-path").addEventListener("click", () => { player.stop(); keys.length = 0; pathChanged(); });
$("save-path").addEventListener("click", async () => {
  const answer = await fetch("path", { method: "POST", body: JSON.stringify({ fps: 25, key: keys }) });
  pathChanged(answer.ok ? `saved: trainer render RUN --path ${(await answer.json()).file}` : await answer.text());
});

// Keys
function help(on) { $("help").hidden = !on; $("help-button").setAttribute("aria-expanded", String(on)); }
$("help-button").addEventListener("click", () => help($("help").hidden));
const step = (e) => (e.ctrlKey || e.metaKey ? 1 : 4);
const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
function hop(by) {
  const usable = [...sliders.values()].map((s) => s.input).filter((i) => !i.disabled);
  const now = usable.indexOf(document.activeElement);
  usable[(now + by + usable.length) % usable.length].focus();
}
addEventListener("keydown", (e) => {
  const inForm = e.target.matches("input, select");
  if (e.altKey || ((e.ctrlKey || e.metaKey) && !arrows[e.key])) return;
  if (e.target === $("divider") && (e.key === "ArrowLeft" || e.key === "ArrowRight")) { e.preventDefault(); return place(state.divider + (e.key === "ArrowLeft" ? -0.02 : 0.02)); }
  if (arrows[e.key]) {
    if (inForm) return;
    e.preventDefault();
    const [x, y] = arrows[e.key], o = state.orbit;
    player.stop();
    if (e.shiftKey) turn({ shift_x: o.shift_x + x * 0.02, shift_y: o.shift_y - y * 0.02 });
    else turn({ yaw_deg: o.yaw_deg + x * step(e), pitch_deg: o.pitch_deg + y * step(e) });
    return;
  }
  const actions = {
    "+": () => turn({ zoom: state.orbit.zoom * 1.1 }), "=": () => turn({ zoom: state.orbit.zoom * 1.1 }), "-": () => turn({ zoom: state.orbit.zoom / 1.1 }),
    0: () => turn(HOME), n: () => choose(info.presets[0]), m: () => overlay(state.overlay === "masks" ? "none" : "masks"), d: () => overlay(state.overlay === "depth" ? "none" : "depth"),
    b: () => compare(!state.compare), k: keep, v: () => stage.focus(), l: () => follow(!state.live), h: () => info.live && followHead(!state.liveHead), "?": () => help($("help").hidden), "[": () => hop(-1), "]": () => hop(1),
  };
  for (let i = 1; i < info.presets.length; i += 1) actions[i] = () => choose(info.presets[i]);
  if (e.key === " " && !e.target.matches("button, input[type=checkbox], input[type=radio], select")) { e.preventDefault(); return play("curve"); }
  const action = actions[e.key.toLowerCase()];
  if (action) { e.preventDefault(); action(); }
});
stage.focus();
follow(true);

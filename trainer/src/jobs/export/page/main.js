// Ties numbers, controls, gestures, keys and pictures together.

import { Blender, Sorter } from "./blend.js";
import { HOME, bounded, viewOf } from "./camera.js";
import { readNumbers } from "./data.js";
import { followGestures } from "./gestures.js";
import { Gpu } from "./gpu.js";
import { make, makePresets, makeSliders, presetAus } from "./panel.js";
import { Player, expressionAt, lengthOf, sweep } from "./player.js";
import { readTable } from "./table.js";

const $ = (id) => document.getElementById(id);
const info = JSON.parse($("info").textContent);
const BACKGROUNDS = ["scene", "dark", "light", "clear"];
// While things move, fewer pixels are drawn where a picture takes longer than this; at rest all of them are.
const PATIENCE_MS = 50, REST_MS = 250, LEAST_SCALE = 0.3;
const state = { orbit: { ...HOME }, aus: { ...info.begin }, background: "scene" };
$("name").textContent = info.name;

const show = {
  trouble(text) { $("trouble").hidden = !text; $("trouble").textContent = text; },
  say(text) { $("status").textContent = text; },
};
for (const event of ["pointerdown", "keydown"]) addEventListener(event, () => show.trouble(""), true);

// Pictures
class Pictures {
  constructor(canvas, numbers) {
    Object.assign(this, { canvas, numbers });
    this.blender = new Blender(numbers, info);
    this.sorter = new Sorter(info.gaussians);
    this.gpu = new Gpu(canvas, numbers, info);
    Object.assign(this, { dirty: true, scale: 0.6, moved: 0, drawn: 0, last: 0, pace: [] });
    canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); show.trouble("The graphics driver gave up: reload the page."); });
    const loop = (now) => { requestAnimationFrame(loop); this.step(now); };
    requestAnimationFrame(loop);
  }

  change() { this.dirty = true; this.moved = performance.now(); }

  // One picture of `what` in so many pixels.
  draw({ orbit, aus, background }, width, height) {
    if (this.blender.blend(aus)) this.gpu.setMoving(this.blender.moving);
    const view = viewOf(info.camera, orbit, width, height);
    const heads = background === "scene" ? null : this.numbers.head;
    this.gpu.draw(view, this.sorter.sort(this.blender.moving, view.rotation, view.translation, heads), background);
    this.drawn += 1;
  }

  step(now) {
    const moving = now - this.moved < REST_MS;
    // At rest, a picture that was taken small is taken once more.
    if (!moving && this.small) this.dirty = true;
    if (!this.dirty) { if (!moving && this.pace.length) { this.pace = []; $("fps").textContent = "0"; } this.last = 0; return; }
    this.dirty = false;
    if (moving && this.last) this.adapt(now - this.last);
    this.last = now;
    const box = $("stage").getBoundingClientRect(), dots = Math.min(devicePixelRatio || 1, 2) * (moving ? this.scale : 1);
    const [width, height] = [box.width, box.height].map((v) => Math.max(8, Math.round(v * dots)));
    this.small = moving && this.scale < 1;
    this.draw(state, width, height);
    $("size").textContent = `${width}×${height}`;
  }

  adapt(millis) {
    this.pace.push(millis);
    if (this.pace.length > 20) this.pace.shift();
    const mean = this.pace.reduce((a, b) => a + b) / this.pace.length;
    $("fps").textContent = (1000 / mean).toFixed(mean > 100 ? 1 : 0);
    if (millis > PATIENCE_MS * 1.3 && millis < 2000) this.scale = Math.max(LEAST_SCALE, this.scale * 0.85);
    else if (millis < PATIENCE_MS * 0.6 && this.scale < 1) this.scale = Math.min(1, this.scale * 1.03);
  }

  // The picture of `options` (orbit, aus, background, width, height; what is left out is as shown) as a data URL of a PNG.
  png(options = {}) {
    const what = { orbit: bounded({ ...HOME, ...(options.orbit ?? state.orbit) }), aus: options.aus ?? state.aus, background: options.background ?? state.background };
    this.draw(what, options.width ?? this.canvas.width, options.height ?? this.canvas.height);
    const url = this.canvas.toDataURL("image/png");
    this.dirty = true;
    return url;
  }
}

let pictures;
try {
  pictures = new Pictures($("picture"), await readNumbers($("numbers").textContent));
} catch (error) {
  show.trouble(`No picture: ${error.message}`);
  throw error;
}
if (info.plate) {
  const image = new Image();
  image.src = info.plate;
  await image.decode();
  pictures.gpu.setPlate(image);
}
const changed = () => pictures.change();

// Expressions
const sliders = makeSliders($("aus"), info, (unit, value) => { player.stop(); state.aus = { ...state.aus, [unit]: value }; changed(); });
function wear(aus) {
  state.aus = { ...aus };
  info.aus.forEach(({ unit, neutral, active }) => sliders.get(unit).show(active ? aus[unit] ?? neutral : 0));
  changed();
}
const choose = (preset) => { player.stop(); wear(presetAus(preset)); show.say(preset.name); };
makePresets($("presets"), info.presets, choose);

// Camera
function turn(change) {
  const o = state.orbit = bounded({ ...state.orbit, ...change });
  $("unseen").hidden = Math.abs(o.yaw_deg) <= info.seen_deg[0] * 1.15 && Math.abs(o.pitch_deg) <= info.seen_deg[1] * 1.15;
  changed();
}
const stage = $("stage");
followGestures(stage, () => state.orbit, turn, () => turn(HOME));
new ResizeObserver(changed).observe(stage);

// Background, picture
function background(value) {
  state.background = value;
  document.querySelector(`input[name=background][value=${value}]`).checked = true;
  stage.classList.toggle("clear", value === "clear");
  changed();
}
for (const radio of document.querySelectorAll("input[name=background]")) radio.addEventListener("change", () => background(radio.value));
function save() {
  const box = stage.getBoundingClientRect(), dots = Math.max(devicePixelRatio || 1, 1);
  const href = pictures.png({ width: Math.round(box.width * dots), height: Math.round(box.height * dots) });
  make("a", { href, download: `${info.name}.png` }).click();
  show.say("picture saved");
}
$("save").addEventListener("click", save);

// Curves
const curves = [];
function offer(curve) {
  curves.push(curve);
  $("curve").append(make("option", { textContent: curve.name, value: curves.length - 1 }));
  $("curve").value = curves.length - 1;
  player.at = 0;
  $("seek").value = 0;
}
const player = new Player((_, at) => {
  const curve = curves[$("curve").value];
  wear(expressionAt(curve, at));
  $("seek").value = (1000 * at) / Math.max(lengthOf(curve), 1e-6);
}, () => { $("play").textContent = "play"; $("play").setAttribute("aria-pressed", "false"); changed(); });
function play() {
  if (player.playing) return player.stop();
  player.start("curve", Math.max(lengthOf(curves[$("curve").value]), 0.04));
  $("play").textContent = "stop";
  $("play").setAttribute("aria-pressed", "true");
}
async function open(file) {
  if (!file) return;
  try {
    const curve = await readTable(file, info.aus, info.arkit);
    player.stop();
    offer(curve);
    show.say(`${curve.name} opened`);
    $("keys").textContent = [`${curve.rows.length} rows, ${lengthOf(curve).toFixed(1)} s, ${curve.units.join(", ")}`, ...curve.notes].join("; ");
    play();
  } catch (error) {
    show.trouble(error.message);
  }
}
offer(sweep(info.aus));
if (info.curves) offer(info.curves);
$("play").addEventListener("click", play);
$("curve").addEventListener("change", () => { player.stop(); player.at = 0; $("seek").value = 0; });
$("seek").addEventListener("input", () => { player.stop(); const c = curves[$("curve").value]; player.at = ($("seek").value / 1000) * lengthOf(c); wear(expressionAt(c, player.at)); });
$("curve-file").addEventListener("change", async () => { await open($("curve-file").files[0]); $("curve-file").value = ""; });
addEventListener("dragover", (e) => { e.preventDefault(); $("drop").hidden = false; });
addEventListener("dragleave", (e) => { if (!e.relatedTarget) $("drop").hidden = true; });
addEventListener("drop", (e) => {
  e.preventDefault();
  $("drop").hidden = true;
  if (e.dataTransfer.files.length) open(e.dataTransfer.files[0]);
  else show.trouble("What was dropped is not a file; a CSV of AU curves is expected.");
});

// Keys
function help(on) { $("help").hidden = !on; $("help-button").setAttribute("aria-expanded", String(on)); }
$("help-button").addEventListener("click", () => help($("help").hidden));
const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
function hop(by) {
  const usable = [...sliders.values()].map((s) => s.input).filter((i) => !i.disabled);
  usable[(usable.indexOf(document.activeElement) + by + usable.length) % usable.length].focus();
}
addEventListener("keydown", (e) => {
  const o = state.orbit;
  if (e.altKey || ((e.ctrlKey || e.metaKey) && !arrows[e.key])) return;
  if (arrows[e.key]) {
    if (e.target.matches("input, select")) return;
    e.preventDefault();
    const [x, y] = arrows[e.key], by = e.ctrlKey || e.metaKey ? 1 : 4;
    if (e.shiftKey) turn({ shift_x: o.shift_x + x * 0.02, shift_y: o.shift_y - y * 0.02 });
    else turn({ yaw_deg: o.yaw_deg + x * by, pitch_deg: o.pitch_deg + y * by });
    return;
  }
  const actions = {
    "+": () => turn({ zoom: o.zoom * 1.1 }), "=": () => turn({ zoom: o.zoom * 1.1 }), "-": () => turn({ zoom: o.zoom / 1.1 }), 0: () => turn(HOME),
    n: () => choose(info.presets[0]), b: () => background(BACKGROUNDS[(BACKGROUNDS.indexOf(state.background) + 1) % BACKGROUNDS.length]), s: save,
    v: () => stage.focus(), "?": () => help($("help").hidden), "[": () => hop(-1), "]": () => hop(1),
  };
  for (let i = 1; i < info.presets.length; i += 1) actions[i] = () => choose(info.presets[i]);
  if (e.key === " " && !e.target.matches("button, input[type=checkbox], input[type=radio], select")) { e.preventDefault(); return play(); }
  const action = actions[e.key.toLowerCase()];
  if (action) { e.preventDefault(); action(); }
});

wear(state.aus);
stage.focus();
// For tests and for scripts in the console.
window.risorius = { state, info, pictures, wear, turn, background, open };

// Tables of AU curves: OpenFace's (`AU12_r`), Live Link Face's (ARKit's names), and a time column with a column per AU.
// What cannot be read says why, in words for the page.

import { unitName } from "./panel.js";

const SECS = ["secs", "seconds", "sec", "time", "time_secs", "timestamp", "t", "time_s"];
const MILLIS = ["frame_time_in_ms", "time_ms", "timestamp_ms", "time_in_ms", "millis", "ms"];
const FRAMES = ["frame", "frame_idx", "frame_index", "frame_number"];
const GUESSED_FPS = 30, MOST_BYTES = 256 * 1024 * 1024;
class Unreadable extends Error {}
const fail = (text) => { throw new Unreadable(text); };

// The unit of a column's name, if it is one: AU12, AU12_r, au_12_intensity; not AU12_c, which is presence.
function unitOf(name) {
  const found = /^au_?0*(\d{1,2})(_r|_intensity)?$/i.exec(name);
  return found ? unitName(Number(found[1])) : null;
}

function separatorOf(header) {
  const counts = [",", ";", "\t"].map((s) => [header.split(s).length, s]);
  return counts.sort((a, b) => b[0] - a[0])[0][1];
}

// Which columns make up each AU, what they are multiplied by, and where the time stands.
function columnsOf(names, arkit) {
  const lower = names.map((n) => n.toLowerCase());
  const phone = lower.includes("timecode") && lower.includes("blendshapecount");
  const units = new Map();
  if (phone) {
    for (const [unit, coefficients] of Object.entries(arkit)) {
      const columns = coefficients.map((c) => lower.indexOf(c.toLowerCase())).filter((c) => c >= 0);
      if (columns.length) units.set(unit, columns);
    }
  } else {
    names.forEach((name, c) => { const unit = unitOf(name); if (unit && (!units.has(unit) || /_(r|intensity)$/i.test(name))) units.set(unit, [c]); });
  }
  const one = (list) => list.map((n) => lower.indexOf(n)).find((c) => c >= 0);
  const time = phone ? { column: lower.indexOf("timecode"), code: true }
    : one(SECS) !== undefined ? { column: one(SECS), factor: 1 } : one(MILLIS) !== undefined ? { column: one(MILLIS), factor: 1e-3 }
      : one(FRAMES) !== undefined ? { column: one(FRAMES), factor: 1 / GUESSED_FPS } : null;
  return { units, time, phone, success: lower.indexOf("success") };
}

// hh:mm:ss:ff.fraction with the frame rate that the greatest frame number tells.
function timecodes(rows, column) {
  const parts = rows.map(({ cells, line }) => {
    const found = /^(\d+):(\d+):(\d+)[:;.](\d+(?:\.\d+)?)$/.exec(cells[column] ?? "");
    return found ? found.slice(1).map(Number) : fail(`line ${line}: \`${cells[column]}\` is no timecode`);
  });
  const most = parts.reduce((m, p) => Math.max(m, p[3]), 0);
  const fps = [24, 25, 30, 50, 60, 120].find((f) => most < f) ?? 120;
  return parts.map(([h, m, s, f]) => 3600 * h + 60 * m + s + f / fps);
}

// A curve of a file's text; `aus` are the avatar's, `arkit` names the coefficients of each AU. Also `notes`: what the user should know.
export function parseTable(name, text, aus, arkit) {
  if (text.includes("\0")) fail(`${name} is not a table of text; a CSV is expected`);
  const lines = text.replace(/^\uFEFF/, "").split(/\r\n|\n|\r/);
  const first = lines.findIndex((l) => l.trim());
  if (first < 0) fail(`${name} is empty`);
  const separator = separatorOf(lines[first]);
  const split = (line) => line.split(separator).map((c) => c.trim().replace(/^"(.*)"$/, "$1"));
  const names = split(lines[first]);
  const { units, time, phone, success } = columnsOf(names, arkit);
  const shown = names.slice(0, 6).map((n) => n.slice(0, 24)).join(", ") + (names.length > 6 ? ", …" : "");
  if (!units.size) fail(`${name} has no column of an AU; its columns are ${shown}\nexpected is a name such as AU12 or AU12_r, and a time such as \`secs\` or \`timestamp\``);
  const movable = aus.filter((a) => a.active).map((a) => a.unit), known = [...units.keys()].filter((u) => movable.includes(u));
  if (!known.length) fail(`${name} has none of the AUs that move this avatar: it has ${[...units.keys()].join(", ")}; the avatar has ${movable.join(", ")}`);
  if (!time) fail(`${name} has no column of times; its columns are ${shown}\nexpected is \`secs\`, \`timestamp\`, \`time_ms\` or \`frame\``);
  const number = (cell, line, column) => {
    if (cell === undefined) fail(`${name}, line ${line}: the row ends before the column \`${names[column]}\``);
    if (cell === "" || /^nan$/i.test(cell)) return null;
    const value = Number(separator === "," ? cell : cell.replace(",", "."));
    return Number.isFinite(value) ? value : fail(`${name}, line ${line}, column \`${names[column]}\`: \`${cell.slice(0, 24)}\` is not a number`);
  };
  const rows = lines.map((line, i) => ({ line: i + 1, text: line })).slice(first + 1).filter((r) => r.text.trim()).map((r) => ({ line: r.line, cells: split(r.text) }));
  if (!rows.length) fail(`${name} has a header and no rows`);
  const times = time.code ? timecodes(rows, time.column)
    : rows.map(({ cells, line }) => (number(cells[time.column], line, time.column) ?? fail(`${name}, line ${line}: has no time`)) * time.factor);
  const back = times.findIndex((t, i) => i > 0 && t <= times[i - 1]);
  if (back > 0) fail(`${name}, line ${rows[back].line}: time does not go on (${times[back]} s after ${times[back - 1]} s)`);
  let most = 0;
  const values = rows.map(({ cells, line }) => {
    if (success >= 0 && Number(cells[success]) === 0) return known.map(() => null);
    return known.map((unit) => {
      const each = units.get(unit).map((c) => number(cells[c], line, c)).filter((v) => v !== null);
      if (!each.length) return null;
      const value = each.reduce((a, b) => a + b) / each.length;
      most = Math.max(most, value);
      return value;
    });
  });
  const notes = [];
  let factor = 1;
  if (phone) factor = 5;
  else if (most > 5.5) { factor = 0.05; notes.push("values up to 100 were taken as percent"); }
  const unused = [...units.keys()].filter((u) => !known.includes(u));
  if (unused.length) notes.push(`not in this avatar: ${unused.join(", ")}`);
  const clamped = (v) => (v === null ? null : Math.min(5, Math.max(0, v * factor)));
  return { name, units: known, times_secs: times, rows: values.map((r) => r.map(clamped)), notes };
}

// A curve of a file that was dropped or chosen.
export async function readTable(file, aus, arkit) {
  try {
    if (file.size > MOST_BYTES) fail(`${file.name} has ${(file.size / 1e6).toFixed(0)} MB; tables up to 256 MB are read`);
    return parseTable(file.name, await file.text(), aus, arkit);
  } catch (error) {
    if (error instanceof Unreadable) throw error;
    throw new Unreadable(`${file.name} cannot be read: ${error.message}`);
  }
}

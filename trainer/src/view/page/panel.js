// The controls: made from what the avatar has.

const COLORS = ["#e69f00", "#56b4e9", "#cc79a7"];

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// One slider per AU, by region. `changed(unit, value)` hears what the user sets.
export function makeSliders(place, info, changed) {
  const sliders = new Map();
  info.regions.forEach((region, n) => {
    const group = make("fieldset", {}, make("legend", { textContent: region }));
    for (const au of info.aus.filter((a) => a.region === n)) {
      const input = make("input", { type: "range", min: 0, max: 5, step: 0.1, value: 0, disabled: !au.active, id: `slider-${au.unit}` });
      input.setAttribute("aria-label", `${au.unit} ${au.name}`);
      const output = make("output", { value: "0.0" });
      const name = make("span", { textContent: au.name, title: au.active ? `${au.name}: ${au.max.toFixed(1)} is the most that was seen` : `${au.name}: never moved in the capture` });
      const row = make("label", { className: au.active ? "au" : "au never" }, make("b", { textContent: au.unit }), name, input, output);
      const show = (value) => {
        input.value = value;
        output.value = Number(value).toFixed(1);
        input.setAttribute("aria-valuetext", `${Number(value).toFixed(1)} of 5`);
        row.classList.toggle("moved", value > 0.05);
      };
      input.addEventListener("input", () => { show(Number(input.value)); changed(au.unit, Number(input.value)); });
      row.addEventListener("dblclick", () => { show(0); changed(au.unit, 0); });
      sliders.set(au.unit, { input, show });
      group.append(row);
    }
    place.append(group);
  });
  return sliders;
}

export function makePresets(place, presets, chosen) {
  presets.forEach((preset, i) => {
    const button = make("button", { textContent: preset.name, title: i === 0 ? "N" : `key ${i}` });
    button.addEventListener("click", () => chosen(preset));
    place.append(button);
  });
}

export function makeLegend(place, regions) {
  regions.forEach((name, n) => {
    const swatch = make("i");
    swatch.style.background = COLORS[n % COLORS.length];
    place.append(make("li", {}, swatch, name));
  });
}

export const unitName = (number) => `AU${String(number).padStart(2, "0")}`;
export const presetAus = (preset) => Object.fromEntries(preset.aus.map(([number, value]) => [unitName(number), value]));

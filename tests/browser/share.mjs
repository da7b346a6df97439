// Opens a page that `trainer export` wrote from the disk, takes its pictures, and uses it as a person would.
//
// usage: node share.mjs FILE.html PICTURES.json FOLDER
//
// PICTURES.json lists what `risorius.pictures.png` takes, with an `id`; FOLDER gets `<id>.png` and screenshots.

import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { differing, inBrowser } from "./page.mjs";

const [file, list, folder] = process.argv.slice(2);

await inBrowser(folder, async (open) => {
  const { page, problems, check, shot } = await open(pathToFileURL(file).href);
  // Software takes its time for pictures: a small page, and patience.
  page.setDefaultTimeout(600000);
  await page.setViewportSize({ width: 900, height: 600 });
  const png = (options) => page.evaluate((o) => window.risorius.pictures.png(o), options);
  const save = (name, url) => writeFileSync(`${folder}/${name}.png`, Buffer.from(url.split(",")[1], "base64"));
  for (const { id, ...options } of JSON.parse(readFileSync(list, "utf8"))) save(id, await png(options));

  // What is on the screen, once nothing moves any more.
  const settle = () => page.waitForFunction(() => { const p = window.risorius.pictures; return !p.dirty && !p.small && performance.now() - p.moved > 400; });
  const seen = async () => {
    await settle();
    const url = await png();
    return page.evaluate(async (u) => {
      const image = new Image();
      image.src = u;
      await image.decode();
      const small = Object.assign(document.createElement("canvas"), { width: 120, height: 100 }).getContext("2d");
      small.drawImage(image, 0, 0, 120, 100);
      return Array.from(small.getImageData(0, 0, 120, 100).data);
    }, url);
  };
  const state = () => page.evaluate(() => window.risorius.state);
  const info = await page.evaluate(() => ({ ...window.risorius.info, plate: null }));
  check(await page.locator(".au").count() === info.aus.length, "one slider per AU");
  check((await page.locator(".au", { hasText: "AU12" }).innerText()).includes("lip corner puller"), "FACS names");
  const rest = await seen();
  check(new Set(rest).size > 20, "the picture shows something");
  await shot("1_neutral");

  // Presets by mouse, sliders by keys.
  await page.getByRole("button", { name: "smile" }).click();
  const smile = await seen();
  check(differing(smile, rest, 6) > 0.001, "a smile changes the picture");
  check(await page.locator("#slider-AU12").inputValue() === "4", "sliders follow the preset");
  await shot("2_smile");
  await page.keyboard.press("v");
  await page.keyboard.press("n");
  check(differing(await seen(), rest, 6) < 0.0005, "neutral comes back");
  await page.keyboard.press("]");
  const active = await page.evaluate(() => document.activeElement.id);
  for (let i = 0; i < 30; i += 1) await page.keyboard.press("ArrowRight");
  check((await state()).aus[active.slice("slider-".length)] >= 3, `arrows set the slider: ${active}`);
  check((await state()).orbit.yaw_deg === 0, "arrows on a slider do not turn the head");
  await page.keyboard.press("v");
  await page.keyboard.press("n");

  // Turning by keys, by mouse, by two fingers; zoom.
  for (let i = 0; i < 3; i += 1) await page.keyboard.press("ArrowRight");
  check((await state()).orbit.yaw_deg === 12, "arrows turn the head");
  check(differing(await seen(), rest, 6) > 0.02, "a turned head looks different");
  await shot("3_turned");
  await page.keyboard.press("+");
  check((await state()).orbit.zoom > 1, "plus zooms");
  await page.keyboard.press("0");
  check(differing(await seen(), rest, 6) < 0.0005, "0 brings the first view back");
  const box = await page.locator("#stage").boundingBox();
  await page.mouse.move(box.x + 300, box.y + 300);
  await page.mouse.down();
  await page.mouse.move(box.x + 340, box.y + 300, { steps: 4 });
  await page.mouse.up();
  check(Math.abs((await state()).orbit.yaw_deg - 10) < 0.1, "dragging turns the head");
  await page.evaluate(() => {
    const stage = document.getElementById("stage");
    stage.setPointerCapture = () => {};
    const send = (type, id, x, y) => stage.dispatchEvent(new PointerEvent(type, { pointerId: id, pointerType: "touch", clientX: x, clientY: y, bubbles: true }));
    window.risorius.turn({ yaw_deg: 0 });
    send("pointerdown", 11, 300, 300); send("pointerdown", 12, 400, 300);
    send("pointermove", 12, 500, 300);
    send("pointerup", 11, 300, 300); send("pointerup", 12, 500, 300);
  });
  const pinched = (await state()).orbit;
  check(Math.abs(pinched.zoom - 2) < 0.01 && pinched.yaw_deg === 0, `two fingers zoom: ${JSON.stringify(pinched)}`);
  await page.keyboard.press("0");

  // Backgrounds.
  for (const [key, name] of [["dark", "4_dark"], ["light", "5_light"], ["clear", "6_clear"]]) {
    await page.locator(`input[value=${key}]`).click();
    await settle();
    await shot(name);
  }
  const alpha = (await seen()).filter((_, i) => i % 4 === 3);
  check(alpha.some((a) => a === 0) && alpha.some((a) => a > 250), "the background is transparent, the head is not");
  const corner = alpha[0];
  check(corner === 0, `a corner is transparent: ${corner}`);
  await page.locator("#stage").focus();
  await page.keyboard.press("b");
  check((await state()).background === "scene", "B goes on to the next background");
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#save").click()]);
  check(download.suggestedFilename().endsWith(".png"), "the picture is saved");

  // Tables: good ones play, bad ones say what is wrong and leave the page as it was.
  const drop = (name, text) => page.evaluate(([n, t]) => {
    const data = new DataTransfer();
    data.items.add(new File([t], n, { type: "text/csv" }));
    dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
  }, [name, text]);
  const trouble = () => page.locator("#trouble");
  for (const [name, text, word] of [
    ["none.csv", "secs,smile\n0,1\n1,2\n", "no column of an AU"],
    ["other.csv", "secs,AU28,AU43\n0,1,1\n1,2,2\n", "none of the AUs that move this avatar"],
    ["timeless.csv", "AU12,AU06\n1,1\n2,2\n", "no column of times"],
    ["broken.csv", "secs,AU12\n0,1\n1,x2\n", "line 3, column `AU12`: `x2` is not a number"],
    ["short.csv", "secs,AU12\n0,1\n1\n", "line 3: the row ends"],
    ["still.csv", "secs,AU12\n0,1\n0,2\n", "time does not go on"],
    ["head.csv", "secs,AU12\n", "no rows"],
    ["empty.csv", "", "is empty"],
    ["picture.png", "\u0089PNG\r\n\u001a\n\0\0\0", "not a table"],
  ]) {
    await drop(name, text);
    await trouble().waitFor({ state: "visible" });
    const said = await trouble().innerText();
    check(said.includes(word) && said.includes(name), `${name}: ${said}`);
    if (name === "other.csv") await shot("7_trouble");
    await page.keyboard.press("v");
    check(!await trouble().isVisible(), "the message goes with the next key");
  }
  check(await page.locator("#curve option").count() === 1, "nothing broken is offered");
  const plays = async (name, text, unit, least) => {
    await page.evaluate(() => window.risorius.wear({}));
    await drop(name, text);
    await page.waitForFunction(([u, l]) => window.risorius.state.aus[u] > l, [unit, least]);
    check(await page.locator("#play").innerText() === "stop", `${name} plays`);
    await page.keyboard.press(" ");
    check(await page.locator("#play").innerText() === "play", "space stops it");
  };
  await plays("plain.csv", "secs;AU12;AU06\n0;0;0\n0,5;4,5;1\n1;0;0\n", "AU12", 0.5);
  await plays("openface.csv", "frame, face_id, timestamp, confidence, success, AU12_r, AU12_c\n1, 0, 0.0, 0.98, 1, 0.5, 1\n2, 0, 0.4, 0.98, 1, 4.0, 1\n3, 0, 0.8, 0.2, 0, 0, 0\n", "AU12", 1);
  await plays("phone.csv", "Timecode,BlendShapeCount,JawOpen,MouthSmileLeft,MouthSmileRight\n00:00:00:00.0,61,0,0,0\n00:00:00:20.0,61,0.8,0.2,0.4\n", "AU26", 1);
  await page.evaluate(() => window.risorius.wear({}));
  await page.setInputFiles("#curve-file", { name: "chosen.csv", mimeType: "text/csv", buffer: Buffer.from("time_ms,AU12\n0,1\n900,4\n") });
  await page.waitForFunction(() => window.risorius.state.aus.AU12 > 1);
  await page.keyboard.press(" ");

  // Pictures a second while every AU plays, on whatever draws here.
  await page.locator("#curve").selectOption("0");
  await page.evaluate(() => { window.before = { at: performance.now(), drawn: window.risorius.pictures.drawn }; });
  await page.locator("#play").click();
  await page.waitForTimeout(3000);
  const pace = await page.evaluate(() => ({ fps: (1000 * (window.risorius.pictures.drawn - window.before.drawn)) / (performance.now() - window.before.at), size: document.getElementById("size").textContent }));
  await shot("8_playing");
  await page.locator("#play").click();
  check(problems.length === 0, `the page says: ${problems.join("; ")}`);
  return { fps: pace.fps, size: pace.size };
});

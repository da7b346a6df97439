// Drives the page of `trainer view` in a real browser, as a person would, and fails where it does not follow.
//
// usage: node view.mjs URL [FOLDER]      FOLDER gets screenshots

import { inBrowser } from "./page.mjs";

const [url, folder] = process.argv.slice(2);

await inBrowser(folder, async (open) => {
  const { page, problems, check, view, settle, pixels, changedShare, shot } = await open(url);
  await settle();
  const { info } = await page.evaluate(() => ({ info: window.risorius.info }));
  const first = await view();
  check(first.canvas[0] === info.width && first.canvas[1] === info.height, `full size at rest: ${first.canvas}`);
  check(await page.locator(".au").count() === info.aus.length, "one slider per AU");
  check((await page.locator(".au", { hasText: "AU12" }).innerText()).includes("lip corner puller"), "FACS names");
  const rest = await pixels();
  check(new Set(rest).size > 20, "the picture shows something");
  await shot("1_neutral");

  // A preset by mouse; only part of the picture changes.
  await page.getByRole("button", { name: "smile" }).click();
  await settle();
  const smile = await changedShare(rest);
  check(smile > 0.001 && smile < 0.6, `a smile changes part of the picture: ${smile}`);
  check(await page.locator("#slider-AU12").inputValue() === "4", "sliders follow the preset");
  await shot("2_smile");

  // Keyboard alone from here: V, N, arrows, a slider.
  await page.keyboard.press("v");
  await page.keyboard.press("n");
  await settle();
  check(await changedShare(rest) < 0.0005, "neutral comes back");
  for (let i = 0; i < 3; i += 1) await page.keyboard.press("ArrowRight");
  await settle();
  check((await view()).orbit.yaw_deg === 12, "arrows turn the head");
  check(await changedShare(rest) > 0.02, "a turned head looks different");
  await shot("3_turned");
  await page.keyboard.press("+");
  check((await view()).orbit.zoom > 1, "plus zooms");
  await page.keyboard.press("0");
  await settle();
  check(await changedShare(rest) < 0.0005, "0 brings the first view back");
  await page.keyboard.press("]");
  const active = await page.evaluate(() => document.activeElement.id);
  check(active.startsWith("slider-AU"), `] goes to a slider: ${active}`);
  for (let i = 0; i < 30; i += 1) await page.keyboard.press("ArrowRight");
  await settle();
  const unit = active.slice("slider-".length);
  check(Math.abs((await view()).aus[unit] - 3) < 1e-6, "arrows set the slider");
  check((await view()).orbit.yaw_deg === 0, "arrows on a slider do not turn the head");
  await page.keyboard.press("v");
  await page.keyboard.press("n");

  // Overlays.
  await page.keyboard.press("m");
  await settle();
  check(await changedShare(rest) > 0.01, "masks show");
  await shot("4_masks");
  await page.keyboard.press("d");
  await settle();
  await shot("5_depth");
  await page.keyboard.press("d");

  // Before and after.
  await page.keyboard.press("2");
  await page.keyboard.press("b");
  await settle();
  await page.waitForTimeout(300);
  check(await page.locator("#divider").isVisible(), "a divider between before and after");
  await shot("6_before_after");
  await page.keyboard.press("b");

  // Dragging turns; while it moves, pictures may be smaller.
  await page.keyboard.press("n");
  await settle();
  const box = await page.locator("#stage").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.down();
  const from = await view(), began = Date.now();
  for (let i = 0; i < 90; i += 1) {
    await page.mouse.move(box.x + box.width / 2 + 50 * Math.sin(i / 8), box.y + box.height / 2 + 20 * Math.cos(i / 8));
    await page.waitForTimeout(25);
  }
  const turned = await view(), secs = (Date.now() - began) / 1000;
  await shot("7_turning");
  await page.mouse.up();
  check(turned.orbit.yaw_deg !== from.orbit.yaw_deg, "dragging turns the head");
  const turning = { fps: (turned.pictures - from.pictures) / secs, size: turned.canvas };
  await settle();
  check((await view()).canvas[0] === info.width, "at rest the picture is full size again");
  await page.mouse.wheel(0, -300);
  check((await view()).orbit.zoom > 1.2, "the wheel zooms");
  await page.keyboard.press("0");

  // An edit by slider at rest: how fast pictures come.
  await settle();
  const slider = page.locator("#slider-AU12");
  await slider.focus();
  const edit = await view(), edits = Date.now();
  for (let i = 0; i < 60; i += 1) { await page.keyboard.press(i % 40 < 20 ? "ArrowRight" : "ArrowLeft"); await page.waitForTimeout(20); }
  const edited = await view();
  const editing = { fps: (edited.pictures - edit.pictures) / ((Date.now() - edits) / 1000), size: edited.canvas };

  // Curves: the built-in one plays by key; one from a file too.
  await page.keyboard.press("v");
  await page.keyboard.press(" ");
  const start = await view(), played = Date.now();
  await page.waitForTimeout(3000);
  const later = await view();
  check(JSON.stringify(start.aus) !== JSON.stringify(later.aus), "the curve plays");
  const playing = { fps: (later.pictures - start.pictures) / ((Date.now() - played) / 1000), size: later.canvas };
  await page.keyboard.press(" ");
  await page.locator("#curve-file").setInputFiles({ name: "two.csv", mimeType: "text/csv", buffer: Buffer.from("secs,AU12\n0,0\n1,5\n2,0\n") });
  await page.waitForFunction(() => document.getElementById("curve").selectedOptions[0].textContent === "two.csv");
  await page.locator("#seek").focus();
  await page.locator("#seek").evaluate((e) => { e.value = 500; e.dispatchEvent(new Event("input")); });
  check(Math.abs((await view()).aus.AU12 - 5) < 0.05, "seeking sets the expression");
  const expected = problems.length;
  await page.locator("#curve-file").setInputFiles({ name: "bad.csv", mimeType: "text/csv", buffer: Buffer.from("secs,smile\n0,0\n") });
  await page.waitForSelector("#trouble:visible");
  check((await page.locator("#trouble").innerText()).includes("no column that is an AU"), "a bad table is explained");
  problems.splice(expected);   // the browser logs the refusal as an error

  // A path of two moments is kept in the run.
  await page.keyboard.press("v");
  await page.keyboard.press("1");
  await page.keyboard.press("k");
  await page.keyboard.press("ArrowLeft");
  await page.keyboard.press("3");
  await page.keyboard.press("k");
  await page.locator("#save-path").click();
  await page.waitForFunction(() => document.getElementById("keys").textContent.includes("saved"));
  await page.keyboard.press("v");
  await page.keyboard.press("?");
  check(await page.locator("#help").isVisible(), "? lists the keys");
  await settle();
  await shot("8_path_and_help");

  // Every control has a name for a screen reader.
  const nameless = await page.evaluate(() => [...document.querySelectorAll("button, input, select")].filter((e) => !(e.getAttribute("aria-label") || e.textContent.trim() || e.closest("label"))).map((e) => e.outerHTML));
  check(nameless.length === 0, `controls without a name: ${nameless}`);
  check(problems.length === 0, `the page complains: ${problems.join("; ")}`);
  return { full: [info.width, info.height], turning, editing, playing };
});

// Watches the page of `trainer view --live` in a real browser while rows of AU curves are piped to it.
//
// usage: node live.mjs TRAINER RUN [FOLDER]      FOLDER gets screenshots

import { spawn } from "node:child_process";
import { createInterface } from "node:readline";
import { differing, inBrowser } from "./page.mjs";

const [trainer, run, folder] = process.argv.slice(2);
const started = [];

// `trainer view` that hears what `tell` says.
async function viewer(...more) {
  const child = spawn(trainer, ["view", run, "--live", "-", ...more], { stdio: ["pipe", "ignore", "pipe"] });
  started.push(child);
  const said = [];
  const url = await new Promise((found, failed) => {
    createInterface({ input: child.stderr }).on("line", (line) => {
      said.push(line);
      const match = line.match(/http\S+/);
      if (match) found(match[0]);
    });
    child.on("exit", (code) => failed(new Error(`trainer view ended (${code}): ${said.join(" ")}`)));
  });
  return { url, tell: (rows) => child.stdin.write(rows), stop: () => child.stdin.end() };
}

// What the controls say.
function following({ page }) {
  const text = (id) => page.locator(id).innerText();
  return {
    status: () => text("#live-status"),
    says: (words) => page.waitForFunction((w) => document.getElementById("live-status").textContent.includes(w), words, { timeout: 60000 }),
    slider: async (unit) => Number(await page.locator(`#slider-${unit}`).inputValue()),
    reaches: (unit, value) => page.waitForFunction(([u, v]) => Math.abs(Number(document.getElementById(`slider-${u}`).value) - v) < 0.051, [unit, value], { timeout: 60000 }),
    on: async () => (await page.locator("#live").getAttribute("aria-pressed")) === "true",
    button: () => text("#live"),
    // Until so many pictures have come that were asked for after now.
    async pictures(count) {
      const from = await page.evaluate(() => window.risorius.picture.pictures);
      await page.waitForFunction((n) => window.risorius.picture.pictures >= n, from + count, { timeout: 60000 });
    },
    // Until the picture has stayed the same for a second: while things move, pictures are smaller.
    async rests() {
      const look = () => page.evaluate(() => document.getElementById("picture").toDataURL());
      for (let seen = await look(), same = 0, tries = 0; same < 5 && tries < 300; tries += 1) {
        await page.waitForTimeout(200);
        const now = await look();
        same = now === seen ? same + 1 : 0;
        seen = now;
      }
    },
  };
}

await inBrowser(folder, async (open) => {
  // Rows as they are, from a plain table.
  const plain = await viewer();
  const page = await open(plain.url);
  const { check } = page, live = following(page);
  check(await page.page.locator("#live-row").isVisible(), "there is a row of controls for the live face");
  check(await live.on() && (await live.button()) === "stop following", "the page follows at once");
  await live.says("waits for rows");
  plain.tell("secs,AU12,AU26\n0,0,0\n");
  await live.says("1 rows");
  check(await live.slider("AU12") === 0, "a face at rest");
  // At rest pictures are of full size.
  await page.page.keyboard.press("l");
  await page.settle();
  const rest = await page.pixels();
  await page.page.keyboard.press("l");
  // Rows that lie more than a second apart are taken as they are; closer ones are filtered.
  plain.tell("5,4,3\n");
  await live.reaches("AU12", 4);
  check(await live.slider("AU26") === 3, "all sliders follow");
  check((await page.page.locator(".au", { hasText: "AU12" }).locator("output").innerText()) === "4.0", "numbers follow");
  await live.pictures(2);
  await page.shot("live_1_smile");

  // A row that cannot be read is told, and the face stays.
  plain.tell("6,much,3\n");
  await live.says("much");
  check(await live.slider("AU12") === 4, "a bad row changes nothing");
  plain.tell("10,,\n");
  await live.says("no face");
  check(await live.slider("AU12") === 4, "without a face the last one is held");

  // A slider stops the following; L takes it up again, and lays it down.
  await page.page.locator("#slider-AU12").focus();
  await page.page.keyboard.press("ArrowLeft");
  check(!(await live.on()) && (await live.button()) === "follow live face", "a slider stops the following");
  plain.tell("15,1,0\n");
  await page.settle();
  check(Math.abs(await live.slider("AU12") - 3.9) < 1e-6, "what comes then is not followed");
  const smile = await page.changedShare(rest);
  check(smile > 0.001 && smile < 0.6, `the picture has followed: ${smile}`);
  await page.page.keyboard.press("v");
  await page.page.keyboard.press("l");
  await live.reaches("AU12", 1);
  check(await live.on(), "L follows again, from where the face is now");
  await page.page.keyboard.press("l");
  check(!(await live.on()), "L stops");
  plain.tell("20,5,5\n");
  await page.settle();
  check(await live.slider("AU12") === 1, "a face that is not followed may move");
  await page.page.keyboard.press("l");
  await live.reaches("AU12", 5);
  await page.page.keyboard.press("2");
  check(!(await live.on()), "a preset stops the following");
  await page.page.keyboard.press("l");
  await live.reaches("AU26", 5);
  await page.page.keyboard.press(" ");
  check(!(await live.on()), "a curve that plays stops the following");
  await page.page.keyboard.press("l");
  await live.reaches("AU12", 5);
  check((await page.page.locator("#play").getAttribute("aria-pressed")) === "false", "following stops the curve");
  plain.stop();
  await live.says("ended");
  check(!(await live.on()), "the end of the rows ends the following");
  check(await live.slider("AU12") === 5, "and leaves the face as it was");
  await page.settle();
  check(page.problems.length === 0, `the page complains: ${page.problems.join("; ")}`);
  await page.page.close();

  // A phone's rows by the driver's own range, with the head.
  const phone = await viewer("--range", "driver");
  const other = await open(phone.url);
  const face = following(other);
  const row = (second, smile, yaw) => `10:00:${String(second).padStart(2, "0")}:00.0,61,${smile},${smile},${yaw},0,0\n`;
  // Such rows are read one by one, and so by the clock of this machine: more than a second apart they are not filtered.
  const later = () => other.page.waitForTimeout(1300);
  phone.tell("Timecode,BlendshapeCount,MouthSmileLeft,MouthSmileRight,HeadYaw,HeadPitch,HeadRoll\n");
  phone.tell(row(0, 0.4, 0));
  const { max } = (await other.page.evaluate(() => window.risorius.info.aus)).find((au) => au.unit === "AU12");
  await face.reaches("AU12", max);
  check(true, "the driver's strongest is the avatar's");
  await later();
  phone.tell(row(3, 0.2, 0));
  await face.reaches("AU12", max / 2);
  check(true, "half of it is half of it");
  await other.page.keyboard.press("h");
  check(await other.page.locator("#live-head").isChecked(), "H follows the head");
  await face.pictures(2);
  await face.rests();
  const ahead = await other.small();
  await later();
  phone.tell(row(6, 0.2, 0.4));
  await face.says("3 rows");
  await face.pictures(2);
  await face.rests();
  const turned = await other.small();
  const turn = differing(turned, ahead, 24);
  check(turn > 0.1, `the head turns with the driver's: ${turn}`);
  await other.shot("live_2_turned");
  await other.page.keyboard.press("h");
  await face.pictures(2);
  check(!(await other.page.locator("#live-head").isChecked()), "H lets go of the head");
  await face.rests();
  const back = differing(await other.small(), ahead, 24);
  check(back < turn / 2, `and it is back where it was: ${back} of ${turn}`);
  check(Math.abs(await face.slider("AU12") - max / 2) < 0.051, "while the face is followed on");
  check(other.problems.length === 0, `the page complains: ${other.problems.join("; ")}`);
  return {};
});
for (const child of started) child.kill();

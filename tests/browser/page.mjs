// A page of `trainer view` or of `trainer export` in a real browser, and how it is asked what it shows.
//
// Needs playwright-core (npm) where node finds it, and Chromium: $CHROMIUM, else /usr/bin/chromium.

import { mkdirSync } from "node:fs";
import { createRequire } from "node:module";

const { chromium } = createRequire(process.env.PLAYWRIGHT_FROM ?? import.meta.url)("playwright-core");

// Opens a browser, hands `work` what opens pages in it, and prints what it gives; `folder` gets screenshots.
export async function inBrowser(folder, work) {
  if (folder) mkdirSync(folder, { recursive: true });
  const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"] });
  const context = await browser.newContext({ viewport: { width: 1280, height: 860 } });
  const tally = { checks: 0, last: null };
  try {
    const result = await work((url) => openPage(context, url, folder, tally));
    console.log(JSON.stringify({ checks: tally.checks, ...result }));
  } catch (error) {
    const said = tally.last?.problems.length ? `; the page says: ${tally.last.problems.join("; ")}` : "";
    await tally.last?.shot("failed");
    console.error(`after ${tally.checks} checks: ${error.message}${said}`);
    process.exitCode = 1;
  } finally {
    await browser.close();
  }
}

async function openPage(context, url, folder, tally) {
  const page = await context.newPage();
  const problems = [];
  page.on("console", (m) => m.type() === "error" && problems.push(m.text()));
  page.on("pageerror", (e) => problems.push(String(e)));
  page.on("request", (r) => r.url() === url || r.url().startsWith(new URL(url).origin) || /^(blob|data):/.test(r.url()) || problems.push(`asks elsewhere: ${r.url()}`));
  const opened = {
    page,
    problems,
    check(holds, what) {
      tally.checks += 1;
      if (!holds) throw new Error(what);
    },
    view: () => page.evaluate(() => ({ ...window.risorius.state, pictures: window.risorius.picture.pictures, settled: window.risorius.picture.settled, canvas: [document.getElementById("picture").width, document.getElementById("picture").height] })),
    // Until a full-size picture of the present state is there.
    settle: () => page.waitForFunction(() => {
      const { picture, state } = window.risorius;
      if (!picture.settled || picture.busy || picture.dirty) return false;
      const asked = JSON.parse(picture.settled);
      return asked.scale === 1 && asked.overlay === state.overlay && JSON.stringify(asked.orbit) === JSON.stringify(state.orbit) && JSON.stringify(asked.aus) === JSON.stringify(state.aus);
    }, null, { timeout: 120000 }),
    pixels: () => page.evaluate(() => { const c = document.getElementById("picture"); return Array.from(c.getContext("2d").getImageData(0, 0, c.width, c.height).data); }),
    // The share of pixels that differ from those of a picture of the same size.
    async changedShare(before) {
      const now = await opened.pixels();
      opened.check(now.length === before.length, "the picture has another size");
      return differing(now, before, 6);
    },
    // The picture at one small size, whatever it was rendered at.
    small: () => page.evaluate(() => {
      const small = Object.assign(document.createElement("canvas"), { width: 48, height: 80 }).getContext("2d");
      small.imageSmoothingQuality = "high";
      small.drawImage(document.getElementById("picture"), 0, 0, 48, 80);
      return Array.from(small.getImageData(0, 0, 48, 80).data);
    }),
    shot: (name) => (folder ? page.screenshot({ path: `${folder}/${name}.png` }) : null),
  };
  tally.last = opened;
  await page.goto(url);
  await page.waitForFunction(() => window.risorius, null, { timeout: 600000 });
  return opened;
}

// The share of pixels that differ by more than `levels` in all.
export function differing(now, before, levels) {
  let changed = 0;
  for (let i = 0; i < now.length; i += 4) if (Math.abs(now[i] - before[i]) + Math.abs(now[i + 1] - before[i + 1]) + Math.abs(now[i + 2] - before[i + 2]) > levels) changed += 1;
  return (4 * changed) / now.length;
}

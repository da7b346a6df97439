// Checks glTF files with Khronos' validator: node validate.cjs FILE...     Needs the npm package gltf-validator.
const fs = require("node:fs");
const path = require("node:path");
const { createRequire } = require("node:module");
const from = process.env.NPM_FROM ?? path.join(__dirname, "../../target/tools/npm/package.json");
const validator = createRequire(from)("gltf-validator");
for (const file of process.argv.slice(2))
  validator.validateBytes(new Uint8Array(fs.readFileSync(file))).then(({ issues }) => {
    if (issues.numErrors + issues.numWarnings === 0) return;
    console.error(`${file}: ${issues.messages.map((m) => `${m.code} ${m.pointer}`).join(", ")}`);
    process.exitCode = 1;
  });

// Bundles src/ and three.js into viewer.js: one classic script, so that a page opens from disk. `npm install && npm run build`.
import { readFileSync } from "node:fs";
import { build } from "esbuild";

const licence = readFileSync("node_modules/three/LICENSE", "utf8").trim();

await build({
  entryPoints: ["src/main.js"],
  outfile: "viewer.js",
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2020",
  charset: "utf8",
  legalComments: "none",
  banner: { js: `/*! ddprt viewer, Apache-2.0. It contains three.js:\n\n${licence}\n*/` },
});

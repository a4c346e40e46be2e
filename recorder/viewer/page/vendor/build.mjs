// Bundle the libraries into libraries.min.js, and copy the style sheet and the licenses.
import { copyFileSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const { packages } = JSON.parse(readFileSync("package-lock.json", "utf8"));
const shipped = ["three", "uplot"].map((name) => {
  const { version, license } = packages[`node_modules/${name}`];
  return { name, title: `${name} ${version} (${license})` };
});
await build({
  entryPoints: ["libraries.mjs"],
  outfile: "libraries.min.js",
  banner: { js: `/* ${shipped.map(({ title }) => title).join(", ")}: see LICENSES.txt */` },
  bundle: true,
  minify: true,
  format: "iife",
  globalName: "libraries",
  legalComments: "none",
  target: "es2022",
});
const texts = shipped.map(({ name, title }) => {
  const text = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim().replaceAll("\r\n", "\n");
  return `${title}\n\n${text}\n`;
});
writeFileSync("LICENSES.txt", texts.join("\n\n"));
copyFileSync("node_modules/uplot/dist/uPlot.min.css", "libraries.min.css");

// Bundles the page into OUT, by default ../service/viewer, with the licences of what is inside.
import { build } from "esbuild";
import { copyFile, mkdir, readFile, writeFile } from "node:fs/promises";

const out = process.env.OUT ?? "../service/viewer";
await mkdir(out, { recursive: true });
const { metafile } = await build({
  entryPoints: ["src/page.ts"],
  outfile: `${out}/page.js`,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "none",
  metafile: true,
  external: ["/viewer/*"],
  logLevel: "warning",
});
for (const file of ["index.html", "style.css", "icon.svg"]) {
  await copyFile(`src/${file}`, `${out}/${file}`);
}

const packages = new Set();
for (const input of Object.keys(metafile.inputs)) {
  const found = input.match(/node_modules\/((?:@[^/]+\/)?[^/]+)\//);
  if (found) packages.add(found[1]);
}
const licences = [];
for (const name of [...packages].sort()) {
  const { version, license } = JSON.parse(await readFile(`node_modules/${name}/package.json`));
  const text = await licence(name);
  licences.push(`${name} ${version} (${license})\n\n${text.trim()}\n`);
}
await writeFile(`${out}/LICENCES.txt`, licences.join(`\n${"-".repeat(80)}\n\n`));

async function licence(name) {
  for (const file of ["LICENSE", "LICENSE.md", "LICENSE.txt"]) {
    try {
      return await readFile(`node_modules/${name}/${file}`, "utf8");
    } catch {}
  }
  throw new Error(`node_modules/${name}: found no licence file.`);
}

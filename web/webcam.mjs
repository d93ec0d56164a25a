// Puts what the page's webcam needs into mediapipe/: MediaPipe, as npm has it, and Google's model.
import { createHash } from "node:crypto";
import { cp, mkdir, readFile, writeFile } from "node:fs/promises";

const FROM = "node_modules/@mediapipe/tasks-vision";
const TO = "mediapipe";
const MODEL = {
  url: "https://storage.googleapis.com/mediapipe-models/pose_landmarker/pose_landmarker_full/float16/1/pose_landmarker_full.task",
  sha256: "4eaa5eb7a98365221087693fcc286334cf0858e2eb6e15b506aa4a7ecdcec4ad",
  file: `${TO}/pose_landmarker.task`,
};

await mkdir(TO, { recursive: true });
for (const file of ["vision_bundle.mjs", "wasm"]) {
  await cp(`${FROM}/${file}`, `${TO}/${file}`, { recursive: true });
}
const kept = await readFile(MODEL.file).catch(() => null);
if (kept && isModel(kept)) process.exit();
const found = await downloaded();
if (!isModel(found)) fail(`its sha256 is not ${MODEL.sha256}`);
await writeFile(MODEL.file, found);

function isModel(bytes) {
  return createHash("sha256").update(bytes).digest("hex") === MODEL.sha256;
}

async function downloaded() {
  const answer = await fetch(MODEL.url).catch(({ cause }) => fail(cause?.message ?? "no answer"));
  if (!answer.ok) fail(`found ${answer.status}`);
  return Buffer.from(await answer.arrayBuffer());
}

function fail(why) {
  console.error(`${MODEL.url}: ${why}; the webcam works once that file is in web/${MODEL.file}.`);
  process.exit(1);
}

// Builds three.min.js of entry.js. What no material of the page draws with is left empty: it would be a sixth of the page.
import { createRequire } from "node:module";
import { dirname, join } from "node:path";
import { build } from "esbuild";

const sources = join(dirname(dirname(createRequire(import.meta.url).resolve("three"))), "src");
const EMPTY = [
  [/ShaderChunk.(.*physical.*|transmission.*|cube_uv.*|iridescence.*|clearcoat.*)\.glsl\.js$/, "export default '';"],
  [/ShaderLib.(mesh(physical|toon|phong|matcap)|shadow|sprite|points|distance|cube|equirect|backgroundCube)\.glsl\.js$/,
    "export const vertex = '', fragment = '';"],
  [/PMREMGenerator\.js$/, "export class PMREMGenerator {}"],
];
const slim = {
  name: "slim",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^three$/ }, () => ({ path: join(sources, "Three.js") }));
    for (const [filter, contents] of EMPTY) onLoad({ filter }, () => ({ contents }));
  },
};
await build({
  entryPoints: ["entry.js"], bundle: true, minify: true, format: "iife", globalName: "THREE", outfile: "three.min.js",
  plugins: [slim], banner: { js: "/* three.js, Copyright 2010-2026 three.js authors, MIT License */" },
});

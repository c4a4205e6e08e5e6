// Stems and petioles (paler: guessed), and nodes.

function makeStem(part) {
  const { mesh } = makeLeaf({ id: null, color: part.color }, part);
  mesh.userData = {};
  mesh.material.opacity = part.isGuessed ? 0.6 : 1;
  return mesh;
}

function drawStem({ path, leaf, isGuessed }) {
  const kind = leaf !== undefined ? "petiole" : isGuessed ? "stem guessed" : "stem";
  return drawing("path", { d: path, class: kind });
}

// `stem` as in plant.json.
function describeStem(stem, data) {
  const { phyllotaxis: name, probability } = stem;
  const angle = name === "spiral" ? ` of ${stem.phyllotaxis_angle}°` : "";
  const chance = name === "unclear" ? "" : ` (probability ${stem.phyllotaxis_probability.toFixed(2)})`;
  const guess = probability < 0.9 ? `, a guess: its probability is ${probability.toFixed(2)}` : "";
  const note = `Found by ${stem.source}${guess}; ${name}${angle}${chance}. Petioles are guessed.`;
  const nodes = stem.nodes.filter((one) => one.traits.height !== undefined).flatMap(({ node, traits, sd, leaves }) =>
    leaves.map((one) => ({ node, leaf: one.leaf, azimuth: one.traits.node_azimuth, height: traits.height, sd: sd.height ?? 0 })));
  const title = `Stem ${stem.stem}: height (${data.unit}) against azimuth`;
  const colors = new Map(data.leaves.map(({ id, color }) => [id, color]));
  const picture = drawNodes(nodes, { title, unit: data.unit, colors, choose: (leaf) => selection.select(leaf) });
  const buttons = exportButtons(() => `${data.plant}_stem_${stem.stem}`, () => picture);
  return [element("h3", {}, title), element("p", { class: "note" }, note), picture, element("p", {}, ...buttons)];
}

// The page over days has it, too.
function drawNodes(nodes, { title, unit, colors, choose, highest = Math.max(...nodes.map(({ height }) => height), 1e-12) }) {
  const at = ({ azimuth, height }) => [30 + ((azimuth ?? 0) / 360) * 260, 210 - (height / highest) * 190];
  const picture = drawing("svg", { class: "nodes", viewBox: "0 0 320 240", role: "img", "aria-label": title });
  const write = (x, y, text) => picture.append(drawing("text", { x, y }, `${text}`));
  for (const azimuth of [0, 90, 180, 270]) write(at({ azimuth, height: 0 })[0], 235, `${azimuth}°`);
  picture.append(drawing("path", { d: "M30 20V210H290" }));
  write(0, 15, `${Number(highest.toPrecision(3))} ${unit}`);
  write(0, 214, "0");
  const numbers = [...new Set(nodes.map(({ node }) => node))];
  for (const shared of numbers.map((number) => nodes.filter(({ node }) => node === number))) {
    const places = shared.map(at).sort(([x], [other]) => x - other);
    picture.append(drawing("path", { d: `M${places.map((place) => place.join(" ")).join("L")}` }));
  }
  for (const node of nodes) {
    const [x, y] = at(node);
    const bar = (190 * node.sd) / highest;
    picture.append(drawing("path", { d: `M${x} ${y - bar}V${y + bar}` }));
    const dot = drawing("circle", { cx: x, cy: y, r: 6, fill: colors.get(node.leaf) });
    dot.addEventListener("click", () => choose(node.leaf));
    picture.append(dot);
    write(x + 8, y + 4, node.leaf);
  }
  return picture;
}

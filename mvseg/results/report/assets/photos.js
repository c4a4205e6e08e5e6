// The photos, cropped to the plant, with outlines of masks in the colours of leaves.

const UNITS = 2000; // width of a picture, of which its outlines are drawn

function buildPhotos(data, addresses, lookThrough) {
  const tiles = document.getElementById("tiles");
  const colors = new Map(data.leaves.map((leaf) => [leaf.id, leaf.color]));
  const marks = new Map(data.leaves.map((leaf) => [leaf.id, []]));
  const names = shortNames(data.views.map(({ name }) => name));
  const figures = data.views.map((view, index) => {
    const picture = drawView(view, addresses.pictures[index], colors, marks);
    const figure = makeFigure({ ...view, short: names[index] }, index, picture, lookThrough);
    figure.dataset.view = index;
    tiles.append(figure);
    return figure;
  });

  const leafOf = (event) => event.target.closest("[data-leaf]")?.dataset.leaf;
  tiles.addEventListener("pointerover", (event) => selection.hover(Number(leafOf(event)) || null));
  tiles.addEventListener("pointerleave", () => selection.hover(null));
  tiles.addEventListener("click", (event) => {
    if (event.target.closest("svg")) selection.select(Number(leafOf(event)) || null);
  });
  selection.listen((selected) => {
    tiles.classList.toggle("chosen", selected !== null);
    for (const [leaf, elements] of marks) for (const one of elements) selection.mark(one, leaf);
    figures.forEach((figure, index) => figure.classList.toggle("shows", showsLeaf(data.views[index], selected)));
  });
  shownView.listen((view) => {
    figures.forEach((figure, index) => figure.classList.toggle("lit", index === view));
    figures[view].scrollIntoView({ block: "nearest" });
  });
}

function showsLeaf(view, leaf) {
  return view.masks.some((mask) => mask.leaf === leaf);
}

function makeFigure(view, index, picture, lookThrough) {
  const name = element("span", { title: view.name }, view.short);
  const look = element("button", {
    type: "button", title: "leaves in 3D over this photo, from its camera",
    "aria-label": `leaves in 3D over photo ${view.name}`,
  }, "3D");
  const enlarge = element("button", {
    type: "button", title: "larger or smaller", "aria-label": `enlarge photo ${view.name}`, "aria-pressed": "false",
  }, "\u2922");
  const figure = element("figure", {}, element("figcaption", {}, name, look, enlarge), picture);
  look.addEventListener("click", () => lookThrough(index));
  enlarge.addEventListener("click", () => {
    const isLarge = figure.classList.toggle("large");
    enlarge.setAttribute("aria-pressed", isLarge);
    figure.scrollIntoView({ block: "nearest" });
  });
  return figure;
}

function drawView(view, address, colors, marks) {
  const height = Math.round(UNITS * view.proportion);
  const leaves = view.masks.filter((mask) => mask.leaf > 0).length;
  const label = `Photo ${view.name} with ${count(leaves, "outlined leaf", "outlined leaves")}`;
  const viewBox = `0 0 ${UNITS} ${height}`;
  const picture = drawing("svg", { class: "photo", viewBox, role: "img", "aria-label": label });
  picture.append(drawing("image", { href: address, width: UNITS, height, preserveAspectRatio: "none" }));
  const numbers = [];
  for (const mask of view.masks) {
    picture.append(drawMask(mask, colors, marks));
    if (mask.leaf > 0) numbers.push(writeNumber(mask, marks));
  }
  picture.append(...view.stems.map(drawStem), ...numbers);
  return picture;
}

function drawMask(mask, colors, marks) {
  if (mask.leaf < 1) return drawing("path", { d: mask.path, class: "unmatched" });
  const color = colors.get(mask.leaf);
  const path = drawing("path", { d: mask.path, fill: color, stroke: color, "data-leaf": mask.leaf });
  marks.get(mask.leaf).push(path);
  return path;
}

function writeNumber(mask, marks) {
  const attributes = { x: mask.at[0], y: mask.at[1], "font-size": mask.height };
  const text = drawing("text", attributes, `${mask.leaf}${mask.is_sure ? "" : "?"}`);
  marks.get(mask.leaf).push(text);
  return text;
}

// One mask, cut out of its photo, with some of what is around it.
function drawCrop(view, mask, address, color) {
  const [x1, y1, x2, y2] = mask.box;
  const side = Math.max(x2 - x1, y2 - y1, 40) * 1.25;
  const corner = [(x1 + x2 - side) / 2, (y1 + y2 - side) / 2].map(Math.round);
  const viewBox = [...corner, Math.round(side), Math.round(side)].join(" ");
  const label = `leaf ${mask.leaf} in photo ${view.name}`;
  const height = Math.round(UNITS * view.proportion);
  return drawing("svg", { class: "photo", viewBox, role: "img", "aria-label": label },
    drawing("image", { href: address, width: UNITS, height, preserveAspectRatio: "none" }),
    drawing("path", { d: mask.path, fill: "none", stroke: color }));
}

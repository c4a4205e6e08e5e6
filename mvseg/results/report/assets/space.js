// The 3D view: leaves, cameras with their photos, the ground. It is drawn when something changes only.

const FIELD = 35; // degrees
const FADED = 0.16; // opacity of leaves that are not selected
const OVER_PHOTO = 0.55; // of all leaves, before a photo
const LAYERS = { leaves: true, stems: true, nodes: false, photos: true, masks: false, numbers: true, ground: true };
const LABEL = { letter: 7, line: 13, steps: [0, 11, 20] }; // pixels; how far a number may be from its leaf

class Space {
  constructor(data, addresses, renderer) {
    this.data = data;
    this.addresses = addresses;
    this.renderer = renderer;
    this.canvas = renderer.domElement;
    this.shown = null; // the view whose photo is behind the leaves
    this.isPending = false;
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 1000);
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    const withShape = data.leaves.filter((leaf) => leaf.id in data.space.leaves);
    this.leaves = withShape.map((leaf) => makeLeaf(leaf, data.space.leaves[leaf.id]));
    const share = 2 / data.views.length;
    const textures = addresses.thumbnails.map((address) => loadTexture(address, () => this.paintMasks()));
    this.cameras = data.space.cameras.map((entry, view) =>
      makeCamera(entry, data.views[view], { view, share, texture: textures[view] }));
    this.ground = makeGround(data.space);
    this.backdrop = makeBackdrop();
    this.groups = {
      leaves: this.leaves.map((leaf) => leaf.mesh), stems: data.space.stems.map(makeStem),
      nodes: data.space.nodes.map((node) => makeNode(node, data.leaves.find((leaf) => leaf.id === node.leaf))),
    };
    this.ground.add(makeShadow([...this.groups.leaves, ...this.groups.stems], data.space, () => this.draw()));
    this.scene = new THREE.Scene().add(
      new THREE.HemisphereLight(0xffffff, 0xb8c0b8, 2), makeLamp(), this.ground, this.backdrop,
      ...Object.values(this.groups).flat(), ...this.cameras.map((one) => one.group));
    this.labels = makeLabels(this.leaves, this.ground.userData, data);
    this.layers = makeLayers(data, () => this.showLayers());
  }

  listen() {
    this.controls.addEventListener("change", () => {
      if (this.shown !== null) this.leavePhoto();
      this.draw();
    });
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    selection.listen(() => this.mark());
    listenToPointer(this);
    const on = (name, event, change) => document.getElementById(name).addEventListener(event, change);
    document.getElementById("space-save").append(...exportButtons(() => `${this.data.plant}_3d`, () => this.figure()));
    on("leaf-colors", "change", () => this.color());
    on("look-plant", "click", () => this.lookAround(this.plant()));
    on("look-all", "click", () => this.lookAround(this.everything()));
    this.color();
    this.showLayers();
    this.resize();
    this.lookAround(this.leaves.length ? this.plant() : this.everything());
  }

  draw() {
    if (this.isPending) return;
    this.isPending = true;
    requestAnimationFrame(() => {
      this.isPending = false;
      this.drawNow();
      this.canvas.dataset.frames = Number(this.canvas.dataset.frames ?? 0) + 1;
    });
  }

  // Leaves in the mean colours of their pixels in the photos, or in those that tell them apart.
  color() {
    const choice = document.getElementById("leaf-colors");
    const colors = this.data.leaves.map(photoColor);
    choice.hidden = !colors.some(Boolean);
    const isByLeaf = choice.hidden || choice.value === "leaf";
    for (const { id, mesh: { material } } of this.leaves) {
      const at = this.data.leaves.findIndex((leaf) => leaf.id === id);
      for (const color of [material.color, material.emissive]) {
        color.set(isByLeaf ? this.data.leaves[at].color : colors[at] ?? "#969696");
      }
    }
    this.draw();
  }

  showLayers() {
    const { leaves, stems, nodes } = this.layers;
    for (const [name, box] of Object.entries({ leaves, stems, nodes })) {
      for (const mesh of this.groups[name]) mesh.visible = box.checked;
    }
    this.paintMasks();
    this.showBackdrop(this.shown);
  }

  // Masks over the photos of the cameras, and over the one behind the leaves.
  paintMasks() {
    const colors = new Map(this.data.leaves.map((leaf) => [leaf.id, leaf.color]));
    const paint = (texture, view, box) => paintTexture(texture, this.layers.masks.checked ? { view, box, colors } : null);
    this.cameras.forEach((one, n) => paint(one.photo.material.map, this.data.views[n], this.data.views[n].box));
    if (this.shown !== null) paint(this.backdrop.material.map, this.data.views[this.shown], [0, 0, 1, 1]);
    this.draw();
  }

  drawNow() {
    // what stands before the viewer's eyes would hide the plant
    const near = this.camera.position.distanceTo(this.controls.target) / 2;
    for (const { center, group } of this.cameras) {
      for (const part of group.children) part.visible = center.distanceTo(this.camera.position) > near;
    }
    this.renderer.render(this.scene, this.camera);
    this.placeLabels();
    for (const { text, spot } of this.labels) {
      text.style.visibility = spot ? "visible" : "hidden";
      if (!spot) continue;
      // in parts of the picture, so that they stand beside their leaves on paper, too
      text.style.left = `${((100 * spot[0]) / this.canvas.clientWidth).toFixed(2)}%`;
      text.style.top = `${((100 * spot[1]) / this.canvas.clientHeight).toFixed(2)}%`;
      text.style.transform = "translate(-50%, -50%)";
    }
  }

  // No label lies on another or over the edge: the nearer one stays, and the other moves aside, or is hidden. Each gets
  // its `spot`.
  placeLabels() {
    const { selected, hovered } = selection;
    const isLit = ({ leaf }) => Boolean(leaf) && [selected, hovered].includes(leaf.id);
    const isShown = ({ leaf }) => (leaf ? this.layers.leaves.checked && this.layers.numbers.checked : this.ground.visible);
    const ordered = this.labels.map((label) => ({ label, ...this.pixelOf(label.at) }))
      .sort((a, b) => isLit(b.label) - isLit(a.label) || a.depth - b.depth);
    const { clientWidth, clientHeight } = this.canvas;
    const within = (at, length, size) => Math.min(Math.max(at, size / 2), length - size / 2);
    const placed = [];
    for (const { label, x, y, depth } of ordered) {
      const width = LABEL.letter * (label.text.textContent.length + 0.5);
      const tries = LABEL.steps.flatMap((step) => [0, 1, 2, 3, 4, 5, 6, 7].map((n) =>
        [within(x + step * Math.cos(n * Math.PI / 4), clientWidth, width),
          within(y + step * Math.sin(n * Math.PI / 4), clientHeight, LABEL.line)]));
      const isInside = Math.abs(x - within(x, clientWidth, 0)) < width && y === within(y, clientHeight, 0);
      const isFree = ([left, top]) => placed.every(([otherX, otherY, other]) =>
        Math.abs(left - otherX) > (width + other) / 2 || Math.abs(top - otherY) > LABEL.line);
      label.spot = (depth < 1 && isInside && isShown(label) && tries.find(isFree)) || null;
      if (label.spot) placed.push([...label.spot, width]);
    }
  }

  // What is shown, as an SVG: a picture of the leaves; labels are text.
  figure() {
    const { renderer, canvas } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    const ratio = renderer.getPixelRatio();
    renderer.setPixelRatio(LARGER);
    this.drawNow();
    const image = drawing("image", { href: canvas.toDataURL("image/png"), width, height });
    renderer.setPixelRatio(ratio);
    this.drawNow();
    const write = (x, y, text) => drawing("text", {
      x, y, "font-size": 12, "font-weight": 600, "text-anchor": "middle", fill: PAPER.ink, stroke: PAPER.back,
      "stroke-width": 2.5, "paint-order": "stroke",
    }, text);
    return drawing("svg", { viewBox: `0 0 ${width} ${height}` }, image,
      ...this.labels.filter(({ spot }) => spot).map(({ text, spot: [x, y] }) => write(x, y + 4, text.textContent)));
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.canvas.parentElement.style.setProperty("--aspect", clientWidth / clientHeight); // that of the print, too
    this.camera.aspect = clientWidth / clientHeight;
    if (this.shown !== null) this.lookThrough(this.shown);
    else this.camera.updateProjectionMatrix();
    this.drawNow(); // at once: paper does not wait for the next frame
    this.draw();
  }

  // Where the middle of a leaf is seen, in pixels of the canvas.
  positionOf(id) {
    return this.pixelOf(this.leaves.find((one) => one.id === id).middle);
  }

  pixelOf(point) {
    const { x, y, z } = point.clone().project(this.camera);
    return { x: ((x + 1) / 2) * this.canvas.clientWidth, y: ((1 - y) / 2) * this.canvas.clientHeight, depth: z };
  }

  litLeaves() {
    return this.leaves.filter((leaf) => leaf.mesh.material.emissiveIntensity > 0).map((leaf) => leaf.id);
  }

  // Leaves that are not selected fade; over a photo all let it shine through.
  mark() {
    const { selected, hovered } = selection;
    for (const leaf of this.leaves) {
      const isLit = leaf.id === selected || leaf.id === hovered;
      const material = leaf.mesh.material;
      material.opacity = selected !== null && !isLit ? FADED : this.shown !== null ? OVER_PHOTO : 1;
      material.depthWrite = material.opacity === 1;
      material.emissiveIntensity = isLit ? 0.45 : 0;
    }
    for (const { text, leaf } of this.labels.filter((label) => label.leaf)) {
      const isLit = leaf.id === selected || leaf.id === hovered;
      text.classList.toggle("lit", isLit);
      text.classList.toggle("faded", selected !== null && !isLit);
    }
    for (const one of this.cameras) one.fade(selected !== null && !one.shows.has(selected));
    this.draw();
  }

  plant() {
    return new THREE.Sphere(new THREE.Vector3(), 1.05);
  }

  everything() {
    const plant = new THREE.Box3().setFromCenterAndSize(new THREE.Vector3(), new THREE.Vector3(1, 1, 1));
    const centers = this.cameras.map((one) => one.center);
    return plant.union(new THREE.Box3().setFromPoints(centers)).getBoundingSphere(new THREE.Sphere());
  }

  // From the front, slightly above; far enough to see all of a ball.
  lookAround({ center, radius }) {
    const field = FIELD * Math.min(1, this.camera.aspect);
    const distance = radius / Math.sin((field / 2) * (Math.PI / 180));
    this.camera.fov = FIELD;
    this.camera.position.set(0.5, 0.5, 1).setLength(distance).add(center);
    this.controls.target.copy(center);
    this.controls.update();
    this.leavePhoto();
  }

  // From where a photo was taken, with the photo behind the leaves; until the viewer turns away.
  lookThrough(view) {
    const { camera } = this;
    const { center, up, ahead, rays } = this.cameras[view];
    const corners = hangBackdrop(this.backdrop, center, cropOf(rays, this.data.views[view].box));
    if (view !== this.shown) setTexture(this.backdrop, loadTexture(this.addresses.pictures[view], () => this.paintMasks()));
    camera.position.copy(center);
    camera.up.copy(up);
    camera.lookAt(ahead.clone().add(center));
    camera.up.set(0, 1, 0); // the controls know no other, and turn the view upright when they are used
    camera.updateMatrixWorld();
    aimAt(camera, corners);
    this.controls.target.copy(center).addScaledVector(ahead, center.length());
    this.showBackdrop(view);
  }

  leavePhoto() {
    this.camera.updateProjectionMatrix();
    this.showBackdrop(null);
  }

  showBackdrop(view) {
    this.shown = view;
    this.backdrop.visible = view !== null;
    this.ground.visible = view === null && this.layers.ground.checked;
    for (const one of this.cameras) one.group.visible = view === null && this.layers.photos.checked;
    const note = document.getElementById("space-note");
    note.textContent = view === null ? describeSpace(this.data)
      : `From the camera of photo ${this.data.views[view].name}, with the photo behind the leaves.`;
    this.mark();
  }
}

function buildSpace(data, addresses) {
  try {
    const canvas = document.getElementById("canvas");
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    const space = new Space(data, addresses, renderer);
    space.listen();
    return space;
  } catch (error) {
    document.getElementById("space-note").textContent = `This browser shows nothing in 3D (${error.message}).`;
    return null;
  }
}

function describeSpace(data) {
  const squares = `Squares on the ground: ${Number(data.space.grid.toPrecision(6))} ${data.unit}.`;
  const how = data.space.upFrom === "stem" ? "are along the stem" : "are not measured";
  const up = data.space.isUpKnown ? "" : ` Up is unknown (--up): heights and angles ${how}.`;
  const hasLeaves = Object.keys(data.space.leaves).length > 0;
  return (hasLeaves ? "" : "Cameras only: there are no shapes in 3D. ") + squares + up;
}

// Numbers of the leaves, and words on the ground; `at` is in the page's frame.
function makeLabels(leaves, { bar, camera }, { space, unit, views }) {
  const step = `${Number(space.grid.toPrecision(6))} ${unit}`;
  const words = [[bar, step], [camera, `camera ${shortNames(views.map(({ name }) => name))[0]}`]].filter(([at]) => at);
  const labels = [...leaves.map((leaf) => [leaf.middle, `${leaf.id}`, leaf]), ...words].map(([at, words, leaf]) =>
    ({ at, leaf, text: element("span", { class: leaf ? null : "ground" }, words) }));
  document.getElementById("space-labels").append(...labels.map(({ text }) => text));
  return labels;
}

// {layer: its checkbox}, for the layers that there are.
function makeLayers({ leaves, space }, change) {
  const isEmpty = { leaves: !leaves.length, stems: !space.stems.length, nodes: !space.nodes.length };
  return Object.fromEntries(Object.entries(LAYERS).map(([name, isShown]) => {
    const box = element("input", { type: "checkbox" });
    box.checked = isShown;
    box.addEventListener("change", change);
    document.getElementById("space-layers").append(element("label", { hidden: isEmpty[name] ? "" : null }, box, name));
    return [name, box];
  }));
}

// What the pointer is on: a leaf, or the photo of a camera.
function listenToPointer({ canvas, camera, leaves, cameras }) {
  const caster = new THREE.Raycaster();
  const meshes = [...leaves.map((leaf) => leaf.mesh), ...cameras.map((one) => one.photo)];
  let pressed = null;

  function find(event) {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const at = new THREE.Vector2(((event.clientX - left) / width) * 2 - 1, 1 - ((event.clientY - top) / height) * 2);
    caster.setFromCamera(at, camera);
    const seen = meshes.filter((mesh) => mesh.visible && mesh.parent.visible);
    return caster.intersectObjects(seen, false)[0]?.object.userData ?? {};
  }

  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) return;
    const { leaf, view } = find(event);
    canvas.classList.toggle("on-leaf", leaf !== undefined || view !== undefined);
    selection.hover(leaf ?? null);
  });
  canvas.addEventListener("pointerleave", () => selection.hover(null));
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointerup", (event) => {
    if (pressed === null || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 5) return;
    const { leaf, view } = find(event);
    if (view !== undefined) shownView.show(view);
    else selection.select(leaf ?? null);
  });
}

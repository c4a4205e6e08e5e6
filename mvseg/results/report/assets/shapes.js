// What stands in the 3D view: leaves, cameras, the ground, and a photo behind the leaves.

const LIGHT = [0.3, 1, 0.2]; // the direction to it: y is up
const SHADOW = { pixels: 512, reach: 1.7, blur: 6, color: "rgba(20, 30, 20, 0.32)" }; // half the side of its picture

function makeLeaf(leaf, { points, faces }) {
  const positions = Float32Array.from(new Int16Array(bytesOf(points).buffer), (step) => step / 32767);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint16Array(bytesOf(faces).buffer), 1));
  geometry.computeVertexNormals();
  const color = new THREE.Color(leaf.color);
  const material = new THREE.MeshLambertMaterial({ color, emissive: color, side: THREE.DoubleSide, transparent: true });
  material.emissiveIntensity = 0;
  const mesh = new THREE.Mesh(geometry, material);
  mesh.userData.leaf = leaf.id;
  return { id: leaf.id, mesh, middle: middleOf(positions) };
}

// "rgb(...)", the mean colour of a leaf in the photos; null where it was not measured.
function photoColor({ traits }) {
  const parts = ["mean_red", "mean_green", "mean_blue"].map((name) => traits?.[name]?.value);
  return parts.every(Number.isFinite) ? `rgb(${parts.map((part) => Math.round(255 * part)).join(", ")})` : null;
}

// A node is an octahedron in the colour of its leaf.
function makeNode({ at }, leaf) {
  const ends = [0, 1, 2].flatMap((axis) => [1, -1].map((side) => [0, 1, 2].map((n) => (n === axis ? side * 0.025 : 0))));
  const points = ends.map((end) => new THREE.Vector3(...at).add(new THREE.Vector3(...end)));
  const geometry = new THREE.BufferGeometry().setFromPoints(points);
  geometry.setIndex([0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]);
  return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: leaf?.color ?? "#969696" }));
}

// The vertex nearest to the mean of all: a number there lies on the leaf, however it is bent.
function middleOf(positions) {
  const points = [];
  for (let at = 0; at < positions.length; at += 3) points.push(new THREE.Vector3().fromArray(positions, at));
  const mean = points.reduce((sum, point) => sum.add(point), new THREE.Vector3()).divideScalar(points.length);
  return points.reduce((best, point) => (point.distanceTo(mean) < best.distanceTo(mean) ? point : best));
}

// A camera is a pyramid with its photo as base; the more cameras, the smaller.
function makeCamera(entry, { masks }, { view, share, texture }) {
  const [center, up, ahead] = [entry.center, entry.up, entry.ahead].map((numbers) => new THREE.Vector3(...numbers));
  const rays = entry.corners.map((corner) => new THREE.Vector3(...corner));
  const depth = center.length() * clamp(share, 0.07, 0.2);
  const corners = rays.map((ray) => center.clone().addScaledVector(ray, depth));
  const lines = corners.flatMap((corner, n) => [center, corner, corner, corners[(n + 1) % 4]]);
  const frame = new THREE.LineSegments(
    new THREE.BufferGeometry().setFromPoints(lines),
    new THREE.LineBasicMaterial({ color: 0x7a8a7d, transparent: true }));
  const photo = new THREE.Mesh(
    makeSheet(corners), new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, transparent: true }));
  photo.userData.view = view;
  const fade = (isFaded) => {
    for (const { material } of [photo, frame]) material.opacity = isFaded ? 0.2 : 1;
  };
  const shows = new Set(masks.map((mask) => mask.leaf));
  return { group: new THREE.Group().add(frame, photo), photo, center, up, ahead, rays, shows, fade };
}

// A picture from its corners: top left, top right, bottom right, bottom left.
function makeSheet(corners) {
  const sheet = new THREE.BufferGeometry().setFromPoints(corners);
  sheet.setAttribute("uv", new THREE.BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]), 2));
  sheet.setIndex([0, 2, 1, 0, 3, 2]);
  return sheet;
}

function loadTexture(address, draw) {
  const texture = new THREE.TextureLoader().load(address, draw);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

// Paint the masks of a view over the part `box` of its photo; null: the photo alone.
function paintTexture(texture, masks) {
  if (!texture?.image) return; // not loaded yet
  const photo = (texture.userData.photo ??= texture.image);
  texture.image = photo;
  if (masks) {
    const { view, box: [x1, y1, x2], colors } = masks;
    texture.image = element("canvas", { width: photo.width, height: photo.height });
    const pen = texture.image.getContext("2d");
    const scale = ((x2 - x1) * photo.width) / UNITS;
    pen.drawImage(photo, 0, 0);
    pen.setTransform(scale, 0, 0, scale, x1 * photo.width, y1 * photo.height);
    pen.globalAlpha = 0.55;
    for (const mask of view.masks.filter(({ leaf }) => leaf > 0)) {
      pen.fillStyle = colors.get(mask.leaf);
      pen.fill(new Path2D(mask.path), "evenodd");
    }
  }
  texture.needsUpdate = true;
}

// Squares, a bar as long as one of them, and from where the first photo was taken.
function makeGround(space) {
  const step = space.grid / space.radius;
  const half = Math.ceil(1 / step) * step;
  const lines = [];
  for (let at = -half; at <= half + step / 2; at += step) {
    lines.push([at, -half], [at, half], [-half, at], [half, at]);
  }
  const place = ([x, z]) => new THREE.Vector3(x, space.ground, z);
  const material = new THREE.LineBasicMaterial({ color: 0x8a988c, transparent: true, opacity: 0.35 });
  const grid = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(lines.map(place)), material);
  const mark = new THREE.MeshBasicMaterial({ color: 0x5d675d, side: THREE.DoubleSide });
  const start = -step * Math.round(0.7 / step);
  const ends = [[0, 0], [step, 0], [step, 0.03], [0, 0.03]].map(([x, z]) => place([start + x, z - start]));
  grid.add(new THREE.Mesh(makeSheet(ends), mark));
  grid.userData.bar = place([start + step / 2, 0.1 - start]);
  const [x, , z] = space.cameras[0].center;
  const away = Math.hypot(x, z);
  const at = (ahead, beside) => place([(ahead * x - beside * z) / away, (ahead * z + beside * x) / away]);
  if (away > 0.1) {
    grid.add(new THREE.Mesh(makeSheet([at(0.8, 0), at(0.8, 0), at(0.9, 0.05), at(0.9, -0.05)]), mark));
    grid.userData.camera = at(1.03, 0);
  }
  return grid;
}

// From above, as the shadow falls.
function makeLamp() {
  const lamp = new THREE.DirectionalLight(0xffffff, 1.5);
  lamp.position.set(...LIGHT);
  return lamp;
}

// The soft shadow of meshes on the ground, as a picture.
function makeShadow(meshes, { ground }, draw) {
  const canvas = element("canvas", { width: SHADOW.pixels, height: SHADOW.pixels });
  const pen = canvas.getContext("2d");
  let path = "";
  const scale = SHADOW.pixels / (2 * SHADOW.reach);
  for (const { geometry: { attributes: { position }, index } } of meshes) {
    const corners = Array.from(index.array, (n) => [0, 2].map((axis) =>
      scale * (position.array[3 * n + axis] - (position.getY(n) - ground) * LIGHT[axis] + SHADOW.reach)));
    for (let n = 0; n < corners.length; n += 3) {
      const [a, b, c] = corners.slice(n, n + 3);
      const isTurned = (b[0] - a[0]) * (c[1] - a[1]) < (b[1] - a[1]) * (c[0] - a[0]); // so that none is a hole in another
      path += `M${(isTurned ? [a, c, b] : [a, b, c]).join("L")}Z`;
    }
  }
  pen.filter = `blur(${SHADOW.blur}px)`;
  pen.fillStyle = SHADOW.color;
  pen.fill(new Path2D(path));
  const [low, high] = [-SHADOW.reach, SHADOW.reach];
  const sheet = makeSheet([[low, low], [high, low], [high, high], [low, high]].map(([x, z]) => new THREE.Vector3(x, ground, z)));
  const map = loadTexture(canvas.toDataURL(), draw);
  return new THREE.Mesh(sheet, new THREE.MeshBasicMaterial({ map, transparent: true, depthWrite: false, side: THREE.DoubleSide }));
}

function makeBackdrop() {
  const backdrop = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }));
  backdrop.visible = false;
  return backdrop;
}

function setTexture({ material }, texture) {
  material.map?.dispose();
  material.map = texture;
  material.needsUpdate = true;
}

// Rays to the corners of a part of a photo, from those to the corners of the photo.
function cropOf(rays, [x1, y1, x2, y2]) {
  const across = rays[1].clone().sub(rays[0]);
  const down = rays[3].clone().sub(rays[0]);
  return [[x1, y1], [x2, y1], [x2, y2], [x1, y2]].map(([x, y]) =>
    rays[0].clone().addScaledVector(across, x).addScaledVector(down, y));
}

// Hang a picture behind the plant, where the camera saw it; returns its corners.
function hangBackdrop(backdrop, center, rays) {
  const depth = (center.length() + 1.5) * 1.02;
  const corners = rays.map((ray) => ray.clone().multiplyScalar(depth).add(center));
  backdrop.geometry.dispose();
  backdrop.geometry = makeSheet(corners);
  return corners;
}

// Let a picture that is parallel to the screen fill the view, without turning the camera.
function aimAt(camera, corners) {
  const [low, high] = [corners[3], corners[1]].map((corner) => camera.worldToLocal(corner.clone()));
  const scale = camera.near / -low.z;
  const half = (Math.max(high.y - low.y, (high.x - low.x) / camera.aspect) / 2) * scale;
  const [x, y] = [((low.x + high.x) / 2) * scale, ((low.y + high.y) / 2) * scale];
  const wide = half * camera.aspect;
  camera.fov = (2 * Math.atan(half / camera.near) * 180) / Math.PI; // for when the viewer turns away
  camera.projectionMatrix.makePerspective(x - wide, x + wide, y + half, y - half, camera.near, camera.far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

// A painted mask: strokes add, the eraser takes away; its largest part counts.

const GRAIN = 2; // units of the picture to a painted pixel
const OFF = 1.2; // units that the outline may be off

class Paint {
  // From nothing, or from a mask that is there.
  constructor(height, mask = null) {
    [this.width, this.height] = [Math.ceil(UNITS / GRAIN), Math.ceil(height / GRAIN)];
    const canvas = element("canvas", { width: this.width, height: this.height });
    this.context = canvas.getContext("2d", { willReadFrequently: true });
    this.context.scale(1 / GRAIN, 1 / GRAIN);
    Object.assign(this.context, { lineCap: "round", lineJoin: "round" });
    if (mask) this.context.fill(new Path2D(mask.path), "evenodd");
  }

  stroke(from, to, { radius, erases }) {
    const { context } = this;
    context.globalCompositeOperation = erases ? "destination-out" : "source-over";
    context.lineWidth = 2 * radius;
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
  }

  // The outline of its largest part, in units; no points where nothing is painted.
  outline() {
    const { width, height } = this;
    const { data } = this.context.getImageData(0, 0, width, height);
    const part = new Int32Array(width * height); // 0: not seen yet
    let [best, most, parts] = [-1, 0, 0];
    for (let start = 0; start < part.length; start += 1) {
      if (part[start] || data[4 * start + 3] < 128) continue;
      parts += 1;
      part[start] = parts;
      const left = [start];
      let size = 0;
      while (left.length) {
        const at = left.pop();
        size += 1;
        const x = at % width;
        for (const next of [x > 0 ? at - 1 : -1, x < width - 1 ? at + 1 : -1, at - width, at + width]) {
          if (next < 0 || next >= part.length || part[next] || data[4 * next + 3] < 128) continue;
          part[next] = parts;
          left.push(next);
        }
      }
      if (size > most) [best, most] = [start, size];
    }
    if (best < 0) return [];
    const number = part[best];
    const isIn = (x, y) => x >= 0 && y >= 0 && x < width && y < height && part[y * width + x] === number;
    return simplify(walkAround(isIn, [best % width, Math.floor(best / width)]), OFF / GRAIN)
      .map(([x, y]) => [x * GRAIN, y * GRAIN]);
  }
}

// The corners of pixels around a connected part, from its first pixel in reading order, the part on the right.
function walkAround(isIn, [x0, y0]) {
  const corners = [];
  let [x, y, dx, dy] = [x0, y0, 1, 0];
  do {
    corners.push([x, y]);
    [x, y] = [x + dx, y + dy];
    const isAhead = (side) => isIn(x + (dx - 1 - side * dy) / 2, y + (dy - 1 + side * dx) / 2); // side: 1 right, -1 left
    if (isAhead(-1) && isAhead(1)) [dx, dy] = [dy, -dx];
    else if (!isAhead(1)) [dx, dy] = [-dy, dx];
  } while (x !== x0 || y !== y0 || dx !== 1 || dy !== 0);
  return corners;
}

// Douglas and Peucker (1973), of a closed line: its first point and the one farthest from it stay.
function simplify(points, off) {
  const far = points.reduce((best, point, n) => (lengthTo(point, points[0]) > lengthTo(points[best], points[0]) ? n : best), 0);
  const kept = new Set([0, far]);
  const left = [[0, far], [far, points.length]];
  while (left.length) {
    const [from, to] = left.pop();
    const [a, b] = [points[from], points[to % points.length]];
    let [worst, most] = [-1, off];
    for (let n = from + 1; n < to; n += 1) {
      const length = lengthTo(a, b);
      const [px, py] = [points[n][0] - a[0], points[n][1] - a[1]];
      const away = length ? Math.abs(px * (b[1] - a[1]) - py * (b[0] - a[0])) / length : Math.hypot(px, py);
      if (away > most) [worst, most] = [n, away];
    }
    if (worst < 0) continue;
    kept.add(worst);
    left.push([from, worst], [worst, to]);
  }
  return [...kept].sort((one, other) => one - other).map((n) => points[n]);
}

function lengthTo([x1, y1], [x2, y2]) {
  return Math.hypot(x1 - x2, y1 - y2);
}

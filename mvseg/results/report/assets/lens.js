// Between units of a picture and pixels of the user's photo, with its distortion.

class Frame {
  constructor({ box, proportion }, { size, lens }, lenses) {
    this.size = size;
    this.left = box[0] * size[0];
    this.top = box[1] * size[1];
    this.scale = ((box[2] - box[0]) * size[0]) / UNITS; // pixels per unit
    this.height = Math.round(UNITS * proportion);
    this.lens = lens === null ? null : lenses[lens];
  }

  // The whole photo, in units: around the picture they are negative or above its size.
  get whole() {
    const [x, y] = [-this.left / this.scale, -this.top / this.scale];
    return { x, y, width: this.size[0] / this.scale, height: this.size[1] / this.scale };
  }

  toPhoto([u, v]) {
    const straight = [this.left + u * this.scale, this.top + v * this.scale];
    const [dx, dy] = this.moveAt(straight);
    return [straight[0] + dx, straight[1] + dy].map((value) => Math.round(value * 100) / 100);
  }

  // The inverse: the moves are smooth and small, so a few steps lead back.
  toPicture(point) {
    let straight = point;
    for (let step = 0; this.lens && step < 12; step += 1) {
      const [dx, dy] = this.moveAt(straight);
      straight = [point[0] - dx, point[1] - dy];
    }
    return [(straight[0] - this.left) / this.scale, (straight[1] - this.top) / this.scale];
  }

  moveAt([x, y]) {
    if (!this.lens) return [0, 0];
    const { columns, rows, moves } = this.lens;
    const [across, down] = [
      clamp((x / this.size[0]) * (columns - 1), 0, columns - 1), clamp((y / this.size[1]) * (rows - 1), 0, rows - 1)];
    const [column, row] = [Math.min(Math.floor(across), columns - 2), Math.min(Math.floor(down), rows - 2)];
    const [a, b] = [across - column, down - row];
    const at = (dx, dy, axis) => moves[2 * ((row + dy) * columns + column + dx) + axis];
    return [0, 1].map((axis) =>
      (1 - b) * ((1 - a) * at(0, 0, axis) + a * at(1, 0, axis)) + b * ((1 - a) * at(0, 1, axis) + a * at(1, 1, axis)));
  }
}

// A point well inside a polygon: of a grid, the one farthest from its edges.
function insidePoint(polygon) {
  const [xs, ys] = [0, 1].map((axis) => polygon.map((point) => point[axis]));
  const [x1, x2, y1, y2] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  let best = polygon[0];
  let depth = 0;
  for (let row = 1; row < 24; row += 1) {
    for (let column = 1; column < 24; column += 1) {
      const point = [x1 + ((x2 - x1) * column) / 24, y1 + ((y2 - y1) * row) / 24];
      const far = isInside(point, polygon) ? distanceToEdges(point, polygon) : 0;
      if (far > depth) [best, depth] = [point, far];
    }
  }
  return best;
}

function isInside([x, y], polygon) {
  let inside = false;
  polygon.forEach(([x1, y1], n) => {
    const [x2, y2] = polygon[(n + 1) % polygon.length];
    if (y1 > y !== y2 > y && x < ((x2 - x1) * (y - y1)) / (y2 - y1) + x1) inside = !inside;
  });
  return inside;
}

function distanceToEdges([x, y], polygon) {
  return Math.min(...polygon.map(([x1, y1], n) => {
    const [x2, y2] = polygon[(n + 1) % polygon.length];
    const length = (x2 - x1) ** 2 + (y2 - y1) ** 2 || 1;
    const share = clamp(((x - x1) * (x2 - x1) + (y - y1) * (y2 - y1)) / length, 0, 1);
    return Math.hypot(x - x1 - share * (x2 - x1), y - y1 - share * (y2 - y1));
  }));
}

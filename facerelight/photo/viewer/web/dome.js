// Maps that depend on where a lamp stands: dome.py.

class Dome {
  constructor(basis, table) {
    this.basis = basis;
    this.table = table;
  }

  // how much of each map a unit direction with z of 0 or more takes
  shares([x, y, z]) {
    const { height: rings, width: places } = this.table[0];
    const ring = (Math.acos(clamp(z, 0, 1)) / (Math.PI / 2)) * (rings - 1);
    const turn = Math.atan2(y, x) / (2 * Math.PI), place = (turn - Math.floor(turn)) * places;
    const i = Math.min(Math.floor(ring), rings - 2), j = Math.floor(place) % places;
    const u = ring - i, v = place - Math.floor(place), after = (j + 1) % places;
    const corners = [i * places + j, i * places + after, (i + 1) * places + j, (i + 1) * places + after];
    const amounts = [(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v];
    return this.table.map(({ values }) => corners.reduce((sum, corner, k) => sum + amounts[k] * values[corner], 0));
  }

  // the map of a direction, never negative
  at(direction) {
    const { height, width } = this.basis[0], out = new Raster(height, width), sum = out.values;
    this.shares(direction).forEach((share, k) => {
      const values = this.basis[k].values;
      for (let p = 0; p < sum.length; p++) sum[p] += share * values[p];
    });
    for (let p = 0; p < sum.length; p++) if (sum[p] < 0) sum[p] = 0;
    return out;
  }
}

// as a turned head sees a direction: photo/face_model.py
function fromHead(direction, rotation) {
  return [0, 1, 2].map((axis) => direction.reduce((sum, value, k) => sum + value * rotation[k][axis], 0));
}

// what is behind the head, brought to its nearest side
function inFront([x, y, z]) {
  return unit([x, y, Math.max(z, 0)]);
}

// How light falls on the bust: photo/bust/shading.py, on the kept part of its grids.

class Shading {
  // coarse: every that many pixels of the fine grid are one
  constructor(model, coarse) {
    const { arrays, facts } = model, { fine, bust, kept } = facts, [top, bottom, left, right] = kept;
    this.constants = { ...facts.constants.surface, ...facts.constants.shading };
    this.coarse = coarse > 1;
    this.density = fine.density / coarse;
    this.row = top / coarse;
    this.column = left / coarse;
    this.height = (bottom - top) / coarse;
    this.width = (right - left) / coarse;
    const heights = arrays.fine_height[0];
    this.surface = coarse === 1 ? heights : heights.resized(heights.height / coarse, heights.width / coarse);
    const shrink = (map) => (coarse === 1 ? map : map.shrunk(this.height, this.width));
    this.normal = raised(arrays.fine_normal).map(shrink);
    this.softNormal = raised(arrays.bust_normal);
    this.low = arrays.bust_low[0];
    this.bust = bust;
    this.fine = fine;
    this.known = new Raster(this.height, this.width);
    for (let row = 0, k = 0; row < this.height; row++) {
      const y = fine.top - (row + this.row + 0.5) / this.density;
      for (let column = 0; column < this.width; column++, k++) {
        const x = (column + this.column + 0.5) / this.density - fine.side;
        this.known.values[k] = smoothStep(clamp((1.15 - Math.hypot(x / 1.6, (y + 0.9) / 2.3)) / 0.3, 0, 1));
      }
    }
    this.softEnds = new Map();
    this.fineEnds = new Map();
  }

  // irradiance of a white bust under points that belong to one lamp
  lit({ directions, weights, size }, soft) {
    return size >= soft ? this.softly(directions, weights, size) : this.sharply(directions, weights, size);
  }

  sharply(directions, weights, size) {
    const { constants } = this, out = new Raster(this.height, this.width), sum = out.values;
    directions.forEach((direction, k) => addLambert(sum, this.normal, direction, weights[k], constants.WRAP));
    const mean = [0, 1, 2].map((axis) => directions.reduce((total, one) => total + one[axis], 0) / directions.length);
    const middle = mean.map((value) => value / Math.max(Math.hypot(...mean), 1e-6));
    if (size < constants.NO_EDGE && this.seesAll(middle)) return out;
    const ends = this.ends(middle);
    const sharp = visible(ends, middle, size, constants.SMALLEST).gaussian(Math.max((0.5 * this.density) / 64, 0.3));
    const vague = visible(ends, middle, size + constants.CLOTHES_SOFT, constants.SMALLEST);
    const smooth = vague.gaussian(constants.CLOTHES_BLUR * this.density);
    for (let p = 0; p < sum.length; p++) {
      const known = this.known.values[p];
      sum[p] *= known * sharp.values[p] + (1 - known) * smooth.values[p];
    }
    return out;
  }

  softly(directions, weights, size) {
    const { constants, bust, fine } = this, [height, width] = bust.size;
    const sum = new Raster(height, width);
    directions.forEach((direction, k) => {
      const facing = new Float32Array(height * width);
      addLambert(facing, this.softNormal, direction, weights[k], constants.WRAP);
      const wide = Math.max(size, constants.LEAST_SOFT);
      const seen = this.seesAll(direction)
        ? null
        : visible(this.coarseEnds(direction), direction, wide, constants.SMALLEST).gaussian(1.1).values;
      for (let p = 0; p < facing.length; p++) {
        sum.values[p] += facing[p] * (seen ? 1 - constants.DEPTH * (1 - seen[p]) : 1);
      }
    });
    const scale = bust.density / this.density;
    return sum.onto(this.height, this.width, [
      scale, (this.column + 0.5) * scale - 0.5 + (bust.side - fine.side) * bust.density,
      scale, (this.row + 0.5) * scale - 0.5 + (bust.top - fine.top) * bust.density,
    ]);
  }

  seesAll([x, y, z]) {
    return Math.hypot(x, y) < this.constants.AT_CAMERA && z > 0;
  }

  ends([x, y]) {
    const side = Math.max(Math.hypot(x, y), 1e-6);
    const towards = [x / side, y / side].map((value) => Math.round(value * 1e4) / 1e4), key = towards.join();
    return kept(this.fineEnds, key, 6, () => this.marched(this.surface, this.density, towards, {
      first: 0.03, growth: this.coarse ? 1.09 : 1.035, bias: this.constants.FINE_BIAS,
      row: this.row, column: this.column, height: this.height, width: this.width,
    }));
  }

  coarseEnds([x, y]) {
    const count = this.constants.AZIMUTHS, turn = Math.atan2(y, x) / (2 * Math.PI);
    const place = (turn - Math.floor(turn)) * count, low = Math.floor(place) % count, share = place - Math.floor(place);
    const [one, two] = [low, (low + 1) % count].map((index) => this.coarseMarched(index));
    return one.map((value, p) => (1 - share) * value + share * two.values[p]);
  }

  coarseMarched(index) {
    const [height, width] = this.bust.size, turn = (2 * Math.PI * index) / this.constants.AZIMUTHS;
    return kept(this.softEnds, index, Infinity, () => this.marched(
      this.low, this.bust.density / 2, [Math.cos(turn), Math.sin(turn)], {
        first: 0.08, growth: 1.06, bias: this.constants.COARSE_BIAS,
        row: 0, column: 0, height: this.low.height, width: this.low.width,
      }).resized(height, width));
  }

  // the angle at which the surface ends in one direction, on a part of it
  marched(surface, density, towards, { first, growth, bias, row, column, height, width }) {
    const { BELOW, REACH } = this.constants;
    const steepest = new Raster(height, width), most = steepest.values.fill(-8);
    const rimmed = surface.framed(BELOW), tall = rimmed.height, wide = rimmed.width, values = rimmed.values;
    for (let step = first, distance = first; distance < REACH; step *= growth, distance += step) {
      const dx = Math.round(distance * towards[0] * density * 32) / 32;
      const dy = Math.round(-distance * towards[1] * density * 32) / 32;
      const x0 = Math.floor(dx), y0 = Math.floor(dy), u = dx - x0, v = dy - y0;
      const a = (1 - u) * (1 - v), b = u * (1 - v), c = (1 - u) * v, d = u * v;
      for (let k = 0; k < height; k++) {
        const here = row + 1 + k, there = here + y0;
        const inside = there >= 0 && there < tall - 1;
        for (let p = k * width, from = here * wide + column + 1, x = column + 1 + x0; p < (k + 1) * width;
          p++, from++, x++) {
          const own = values[from];
          let reached = BELOW;
          if (inside && x >= 0 && x < wide - 1) {
            const t = there * wide + x;
            reached = a * values[t] + b * values[t + 1] + c * values[t + wide] + d * values[t + wide + 1];
          }
          const slope = (reached - own - bias) / distance;
          if (slope > most[p]) most[p] = slope;
        }
      }
    }
    for (let p = 0; p < most.length; p++) most[p] = Math.atan(most[p]);
    return steepest;
  }
}

// unit vectors that were flattened onto the plane
function raised([across, up]) {
  const long = across.map((x, p) => x * x + up.values[p] ** 2), scaled = (x, p) => (2 * x) / (1 + long.values[p]);
  return [across.map(scaled), up.map(scaled), long.map((square) => (1 - square) / (1 + square))];
}

function addLambert(sum, normal, [x, y, z], weight, wrap) {
  const [nx, ny, nz] = normal.map((part) => part.values), scale = weight / (1 + wrap);
  for (let p = 0; p < sum.length; p++) {
    const facing = nx[p] * x + ny[p] * y + nz[p] * z + wrap;
    if (facing > 0) sum[p] += scale * facing;
  }
}

// the share of a lamp's disc above the horizon
function visible(ends, [x, y, z], size, smallest) {
  const rise = Math.atan2(z, Math.hypot(x, y)), wide = 2 * Math.max(size, smallest) * RADIANS;
  return ends.map((end) => smoothStep(clamp((rise - end) / wide + 0.5, 0, 1)));
}

// a value made once; only the `most` that were made last are kept
function kept(cache, key, most, make) {
  if (!cache.has(key)) {
    cache.set(key, make());
    if (cache.size > most) cache.delete(cache.keys().next().value);
  }
  return cache.get(key);
}

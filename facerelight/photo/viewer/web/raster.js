// Maps of numbers, and what the relighting does with them: seen through an affine map, blurred, resized.

class Raster {
  constructor(height, width, values) {
    this.height = height;
    this.width = width;
    this.values = values || new Float32Array(height * width);
  }

  map(change) {
    return new Raster(this.height, this.width, this.values.map(change));
  }

  // between pixels, (x, y) from the middle of the first one; beyond the border its values, or `outside`
  at(x, y, outside) {
    const { height, width, values } = this;
    if (outside !== undefined && (x <= -1 || y <= -1 || x >= width || y >= height)) return outside;
    const x0 = Math.floor(x), y0 = Math.floor(y), u = x - x0, v = y - y0;
    const inside = x0 >= 0 && y0 >= 0 && x0 < width - 1 && y0 < height - 1;
    if (inside) {
      const k = y0 * width + x0;
      return (1 - v) * ((1 - u) * values[k] + u * values[k + 1]) +
        v * ((1 - u) * values[k + width] + u * values[k + width + 1]);
    }
    const get = (column, row) => {
      if (outside !== undefined && (column < 0 || row < 0 || column >= width || row >= height)) return outside;
      return values[clamp(row, 0, height - 1) * width + clamp(column, 0, width - 1)];
    };
    return (1 - v) * ((1 - u) * get(x0, y0) + u * get(x0 + 1, y0)) +
      v * ((1 - u) * get(x0, y0 + 1) + u * get(x0 + 1, y0 + 1));
  }

  // seen on another raster, whose pixel (column, row) lies at (ax column + bx, ay row + by) of this one
  onto(height, width, [ax, bx, ay, by], outside) {
    const out = new Raster(height, width);
    for (let row = 0, k = 0; row < height; row++) {
      for (let column = 0; column < width; column++, k++) {
        out.values[k] = this.at(ax * column + bx, ay * row + by, outside);
      }
    }
    return out;
  }

  resized(height, width) {
    const sx = this.width / width, sy = this.height / height;
    return this.onto(height, width, [sx, sx / 2 - 0.5, sy, sy / 2 - 0.5]);
  }

  // the mean over the part of this raster that each new pixel covers
  shrunk(height, width) {
    const across = new Raster(this.height, width), out = new Raster(height, width);
    const columns = overlaps(this.width, width), rows = overlaps(this.height, height);
    for (let row = 0; row < this.height; row++) {
      for (let column = 0; column < width; column++) {
        let sum = 0;
        for (const [from, share] of columns[column]) sum += share * this.values[row * this.width + from];
        across.values[row * width + column] = sum;
      }
    }
    for (let row = 0; row < height; row++) {
      for (const [from, share] of rows[row]) {
        for (let column = 0; column < width; column++) {
          out.values[row * width + column] += share * across.values[from * width + column];
        }
      }
    }
    return out;
  }

  part(row, column, height, width) {
    const out = new Raster(height, width);
    for (let k = 0; k < height; k++) {
      const start = (row + k) * this.width + column;
      out.values.set(this.values.subarray(start, start + width), k * width);
    }
    return out;
  }

  // with one more pixel on every side
  framed(value) {
    const out = new Raster(this.height + 2, this.width + 2);
    out.values.fill(value);
    for (let row = 0; row < this.height; row++) {
      out.values.set(this.values.subarray(row * this.width, (row + 1) * this.width), (row + 1) * out.width + 1);
    }
    return out;
  }

  // Gaussian, `sigma` in pixels; a wide one on a smaller raster
  blurred(sigma) {
    if (sigma <= WIDE) return this.gaussian(Math.max(sigma, 0.3));
    const shrink = WIDE / (2 * sigma);
    const height = Math.ceil(this.height * shrink), width = Math.ceil(this.width * shrink);
    const scale = Math.sqrt((height * width) / (this.height * this.width));
    const own = Math.sqrt((sigma * scale) ** 2 - 1 / 12 - 1 / 6);
    return this.shrunk(height, width).gaussian(own).resized(this.height, this.width);
  }

  gaussian(sigma) {
    const reach = Math.round(sigma * 4), kernel = new Float32Array(reach + 1);
    let total = 0;
    for (let k = 0; k <= reach; k++) {
      kernel[k] = Math.exp(-0.5 * (k / sigma) ** 2);
      total += k ? 2 * kernel[k] : kernel[k];
    }
    for (let k = 0; k <= reach; k++) kernel[k] /= total;
    const { height, width, values } = this;
    const across = new Float32Array(values.length), out = new Raster(height, width);
    const line = new Float32Array(width + 2 * reach);
    for (let row = 0; row < height; row++) {
      line.set(values.subarray(row * width, (row + 1) * width), reach);
      for (let k = 1; k <= reach; k++) {
        line[reach - k] = line[reach + mirrored(k, width)];
        line[reach + width - 1 + k] = line[reach + mirrored(width - 1 + k, width)];
      }
      for (let column = 0, to = row * width; column < width; column++, to++) {
        const middle = column + reach;
        let sum = kernel[0] * line[middle];
        for (let k = 1; k <= reach; k++) sum += kernel[k] * (line[middle - k] + line[middle + k]);
        across[to] = sum;
      }
    }
    for (let row = 0; row < height; row++) {
      const to = row * width;
      for (let column = 0; column < width; column++) out.values[to + column] = kernel[0] * across[to + column];
      for (let k = 1; k <= reach; k++) {
        const above = mirrored(row - k, height) * width, below = mirrored(row + k, height) * width, share = kernel[k];
        for (let column = 0; column < width; column++) {
          out.values[to + column] += share * (across[above + column] + across[below + column]);
        }
      }
    }
    return out;
  }
}

const WIDE = 8; // pixels, as photo.bust.frame has it

const clamp = (value, low, high) => (value < low ? low : value > high ? high : value);

const smoothStep = (share) => share * share * (3 - 2 * share);

// a place beyond a border, mirrored at the middle of the outermost pixel
function mirrored(place, size) {
  if (size === 1) return 0;
  const period = 2 * size - 2, inside = ((place % period) + period) % period;
  return inside < size ? inside : period - inside;
}

// which of `from` pixels each of `to` pixels covers, and by what share
function overlaps(from, to) {
  const step = from / to;
  return Array.from({ length: to }, (_, k) => {
    const low = k * step, high = Math.min((k + 1) * step, from), found = [];
    for (let place = Math.floor(low); place < high - 1e-9; place++) {
      found.push([place, (Math.min(place + 1, high) - Math.max(place, low)) / (high - low)]);
    }
    return found;
  });
}

function quantile(values, share) {
  const sorted = Float32Array.from(values).sort(), place = share * (sorted.length - 1), low = Math.floor(place);
  return sorted[low] + (place - low) * (sorted[Math.min(low + 1, sorted.length - 1)] - sorted[low]);
}

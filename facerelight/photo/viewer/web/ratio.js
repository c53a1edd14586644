// The log ratio of new light over old: photo/ratio.py, on the kept part of the fine grid, and photo/person.py.

class Ratio {
  constructor(model, coarse) {
    const { arrays, facts } = model;
    this.facts = facts;
    this.constants = facts.constants.ratio;
    this.shading = new Shading(model, coarse);
    this.dome = new Dome(arrays.face_basis, arrays.face_table);
    this.faceNormal = raised(arrays.face_normal);
    this.cache = new Map();
    this.fullyLit = this.radiance([0, 0, 1]).blurred(6).map((value) => Math.max(value, 1e-3));
    this.frameFace(arrays);
    const own = this.maps([{ ...facts.own, strength: 1, colour: [1, 1, 1] }]);
    this.ownFace = own.face[0];
    this.ownBust = own.bust[0];
    this.ownLevel = Math.max(largest(this.ownBust.values), 1e-6);
    const seen = this.ontoFace(arrays.face_luminance[0].blurred(0.8), 1);
    this.unexplained = this.trust.map((trust, p) =>
      trust * clamp(Math.log((this.ownFace.values[p] + facts.dark) / (seen.values[p] + facts.dark)), -1, 1));
    this.exposed = this.samples(model);
  }

  // the part of the grid where the face is, and as far as it is joined with the rest
  frameFace(arrays) {
    const { shading, constants } = this, [[, , x0], [, , y0]] = [this.facts.crop_to_bust[0], this.facts.crop_to_bust[1]];
    const { height, width } = arrays.face_weight[0], scale = this.facts.crop_to_bust[0][0];
    const reach = 3.2 * constants.JOIN, density = shading.density, { side, top } = this.facts.fine;
    const from = (x) => Math.floor((x + side) * density), down = (y) => Math.floor((top - y) * density);
    const left = clamp(from(x0 - reach) - shading.column, 0, shading.width - 2);
    const right = clamp(from(x0 + scale * width + reach) - shading.column, left + 2, shading.width);
    const above = clamp(down(y0 + reach) - shading.row, 0, shading.height - 2);
    const below = clamp(down(y0 - scale * height - reach) - shading.row, above + 2, shading.height);
    this.box = { row: above, column: left, height: below - above, width: right - left };
    this.weight = this.ontoFace(arrays.face_weight[0]);
    this.trust = this.ontoFace(arrays.face_trust[0]);
    const rim = this.ontoFace(arrays.face_mask[0].blurred(1.5));
    this.rim = this.weight.map((w, p) => 4 * w * (1 - w) * rim.values[p] + 0.02 * w);
    this.norm = this.weight.blurred(constants.COARSE * density).map((value) => Math.max(value, 1e-3));
    this.nearRim = this.rim.blurred(constants.JOIN * density);
    this.sure = this.trust.map((trust, p) => (this.weight.values[p] > 0 ? trust + constants.HEARSAY : 0));
    this.around = this.sure.blurred(constants.AROUND * density).map((value) => Math.max(value, 1e-4));
  }

  // a map of the model's crop on the face's part
  ontoFace(map, outside = 0) {
    const { shading, box } = this, [[scale, , x0], [, , y0]] = this.facts.crop_to_bust, { side, top } = this.facts.fine;
    const step = 1 / (shading.density * scale);
    const left = (box.column + shading.column + 0.5) / shading.density - side;
    const high = top - (box.row + shading.row + 0.5) / shading.density;
    return map.onto(box.height, box.width, [step, (left - x0) / scale, step, (y0 - high) / scale], outside);
  }

  // log ratios, one a channel, on the shading's raster
  of(sources) {
    const { face, bust } = this.maps(sources);
    return face.map((one, k) => this.joined(one, bust[k]));
  }

  maps(sources) {
    const { SOFT } = this.constants;
    const lit = sources.filter(({ strength }) => strength > 0);
    const soft = (lit.find(({ size }) => size >= SOFT) || {}).size;
    const channels = lit.every(({ colour }) => colour[0] === colour[1] && colour[1] === colour[2]) ? 1 : 3;
    const { box, shading } = this;
    const face = Array.from({ length: channels }, () => new Raster(box.height, box.width));
    const bust = Array.from({ length: channels }, () => new Raster(shading.height, shading.width));
    for (const source of lit) {
      const size = source.size >= SOFT ? soft : source.size; // large ones are taken together
      const key = [size, ...source.directions[0], source.directions.length, source.weights[0]].join();
      const found = kept(this.cache, key, 5, () => ({
        face: this.ontoFace(this.faceLight(this.shading.coarse ? gathered(source, size) : { ...source, size })),
        bust: shading.lit({ ...source, size }, SOFT),
      }));
      for (let c = 0; c < channels; c++) {
        add(face[c].values, found.face.values, source.strength * source.colour[c]);
        add(bust[c].values, found.bust.values, source.strength * source.colour[c]);
      }
    }
    return { face, bust };
  }

  // the head as it is turned: photo/face_model.py and geometry/behind.py
  radiance(direction) {
    const seen = fromHead(direction, this.facts.rotation), side = inFront(seen), radiance = this.dome.at(side);
    if (seen[2] >= 0) return radiance;
    const err = this.facts.constants.behind.NORMALS_ERR, normals = this.faceNormal.map((axis) => axis.values);
    const facing = (light, p) => light[0] * normals[0][p] + light[1] * normals[1][p] + light[2] * normals[2][p] + err;
    return radiance.map((value, p) => value * clamp(facing(seen, p) / Math.max(facing(side, p), 1e-3), 0, 1));
  }

  faceLight({ directions, weights, size }) {
    const { SOFT, LEAK } = this.constants, edged = clamp((SOFT - size) / 10, 0, 1);
    const sum = new Raster(this.fullyLit.height, this.fullyLit.width), full = this.fullyLit.values;
    directions.forEach((direction, k) => {
      const radiance = this.radiance(direction).values;
      for (let p = 0; p < radiance.length; p++) {
        let value = radiance[p];
        if (edged && value > 0) {
          const share = value / full[p], deeper = (share * (1 + LEAK)) / (share + LEAK);
          value *= edged === 1 ? deeper : deeper ** edged;
        }
        sum.values[p] += weights[k] * value;
      }
    });
    return sum;
  }

  joined(face, bust) {
    const { box, shading, constants, weight, trust, rim } = this, { dark } = this.facts, density = shading.density;
    const level = Math.max(largest(bust.values), 1e-6);
    const ofBust = (faint) => {
      const less = faint * level, ownLess = faint * this.ownLevel, own = this.ownBust.values;
      return (p) => Math.log((bust.values[p] + less) / (own[p] + ownLess));
    };
    const nearFace = ofBust(constants.FAINT_FACE), beyond = ofBust(constants.FAINT);
    const place = (p) => (box.row + ((p / box.width) | 0)) * shading.width + box.column + (p % box.width);
    const seen = weight.values.map((w) => (w > 0 ? 1 : 0));
    const shaped = weight.map((_, p) => (seen[p] ? nearFace(place(p)) : 0));
    const inner = face.map((value, p) => (seen[p] ? Math.log((value + dark) / (this.ownFace.values[p] + dark)) : 0));
    const gap = weight.map((w, p) => w * (inner.values[p] - shaped.values[p])).blurred(constants.COARSE * density);
    const { EDGES, DARKEST, BRIGHTEST } = constants, values = inner.values;
    for (let p = 0; p < values.length; p++) {
      const edged = clamp(shaped.values[p] + gap.values[p] / this.norm.values[p], DARKEST, BRIGHTEST);
      values[p] += EDGES * (edged - values[p]);
    }
    const changed = this.changed(values);
    for (let p = 0; p < values.length; p++) values[p] += changed * this.unexplained.values[p];
    const around = inner.map((value, p) => value * this.sure.values[p]).blurred(constants.AROUND * density);
    for (let p = 0; p < values.length; p++) {
      const t = trust.values[p];
      values[p] = t * values[p] + ((1 - t) * around.values[p]) / this.around.values[p];
    }
    const outer = new Raster(shading.height, shading.width).map((_, p) => beyond(p));
    return this.blended(inner, this.levelled(inner, outer, rim, place), place);
  }

  // how surely the light is another
  changed(values) {
    let total = 0, mean = 0, variance = 0;
    const amount = (p) => this.weight.values[p] * this.trust.values[p] + 1e-6;
    for (let p = 0; p < values.length; p++) if (this.weight.values[p] > 0) total += amount(p);
    for (let p = 0; p < values.length; p++) if (this.weight.values[p] > 0) mean += (amount(p) * values[p]) / total;
    for (let p = 0; p < values.length; p++) {
      if (this.weight.values[p] > 0) variance += (amount(p) * (values[p] - mean) ** 2) / total;
    }
    return variance / (variance + this.constants.SAME_LIGHT ** 2);
  }

  // what is beyond the face, moved to meet it
  levelled(inner, outer, rim, place) {
    const { constants, nearRim } = this;
    let total = 0, apart = 0;
    rim.values.forEach((share, p) => {
      total += share;
      apart += share ? share * (inner.values[p] - outer.values[place(p)]) : 0;
    });
    const level = apart / Math.max(total, 1e-6);
    const differs = rim.map((share, p) => (share ? share * (inner.values[p] - outer.values[place(p)] - level) : 0));
    const near = differs.blurred(constants.JOIN * this.shading.density), { LEVEL, NEAR_RIM } = constants;
    const moved = clamp(level, -LEVEL, LEVEL);
    for (let p = 0; p < outer.values.length; p++) outer.values[p] += moved;
    near.values.forEach((value, p) => {
      const wanted = clamp(value / Math.max(nearRim.values[p], 1e-4), -NEAR_RIM, NEAR_RIM);
      outer.values[place(p)] += wanted * clamp(6 * nearRim.values[p], 0, 1);
    });
    return outer;
  }

  blended(inner, outer, place) {
    const { constants, weight } = this, inside = inner.values.filter((_, p) => weight.values[p] > 0.5);
    if (inside.length) {
      const low = quantile(inside, 0.05) - constants.DEEPER, high = quantile(inside, 0.95) + constants.BRIGHTER;
      for (let p = 0; p < outer.values.length; p++) outer.values[p] = clamp(outer.values[p], low, high);
    }
    const out = outer.gaussian((1.2 * this.shading.density) / 64);
    const { BUST_DARKEST, BUST_BRIGHTEST, DARKEST, BRIGHTEST } = constants;
    for (let p = 0; p < out.values.length; p++) out.values[p] = clamp(out.values[p], BUST_DARKEST, BUST_BRIGHTEST);
    weight.values.forEach((w, p) => {
      if (w > 0) {
        const k = place(p);
        out.values[k] = w * clamp(inner.values[p], DARKEST, BRIGHTEST) + (1 - w) * out.values[k];
      }
    });
    return out;
  }

  // where the skin is that the picture is exposed for: places on the raster, luminance, and share of the ratio
  samples({ arrays, facts, luminanceAt }) {
    const [exposed] = arrays.copy_exposed, found = { x: [], y: [], luminance: [], share: [] };
    const step = this.shading.density < 64 ? 2 : 1;
    for (let row = 0; row < exposed.height; row += step) {
      for (let column = 0; column < exposed.width; column += step) {
        const k = row * exposed.width + column;
        if (!exposed.values[k]) continue;
        const [x, y] = this.fromCopy(column, row);
        found.x.push(x);
        found.y.push(y);
        found.luminance.push(luminanceAt(column, row));
        found.share.push(1 - facts.constants.person.EYEBALL * arrays.copy_eyeballs[0].values[k]);
      }
    }
    return found;
  }

  // a pixel of the copy on the raster
  fromCopy(column, row) {
    const { shading, facts } = this, [x, y] = facts.copy_to_bust.map(([a, b, c]) => a * column + b * row + c);
    return [
      (x + facts.fine.side) * shading.density - 0.5 - shading.column,
      (facts.fine.top - y) * shading.density - 0.5 - shading.row,
    ];
  }

  // how surely the light is another on this person, and how much brighter to expose, in log
  exposure(ratios) {
    const { exposed, facts } = this, { LIFT, ROOM, DARKER, BRIGHTER } = facts.constants.person, count = exposed.x.length;
    const relit = new Float32Array(count);
    let mean = 0, square = 0;
    for (let k = 0; k < count; k++) {
      let ratio = 0;
      for (const one of ratios) ratio += one.at(exposed.x[k], exposed.y[k]);
      ratio *= exposed.share[k] / ratios.length;
      mean += ratio / count;
      square += (ratio * ratio) / count;
      relit[k] = exposed.luminance[k] * Math.exp(ratio);
    }
    const variance = Math.max(square - mean * mean, 0);
    const change = variance / (variance + this.constants.SAME_LIGHT ** 2);
    if (facts.exposed === null || !count) return { change, exposure: 0 };
    const before = Math.max(facts.exposed, 1e-4), after = Math.max(quantile(relit, facts.constants.person.EXPOSED), 1e-4);
    const lift = LIFT * change * Math.max(1 - Math.max(before, 0.5 * facts.white) / ROOM, 0);
    return { change, exposure: clamp(Math.log(before / after) + lift, DARKER, BRIGHTER) };
  }
}

// a lamp as one point, a draft of it; the fill and other wide ones stay what they are
function gathered(source, size) {
  if (size > 16) return { ...source, size };
  const total = source.weights.reduce((sum, one) => sum + one, 0);
  const mean = [0, 1, 2].map((axis) => source.directions.reduce((sum, one) => sum + one[axis], 0));
  return { directions: [unit(mean)], weights: [total], size };
}

function largest(values) {
  let most = -Infinity;
  for (let p = 0; p < values.length; p++) if (values[p] > most) most = values[p];
  return most;
}

function add(sum, values, share) {
  for (let p = 0; p < sum.length; p++) sum[p] += share * values[p];
}

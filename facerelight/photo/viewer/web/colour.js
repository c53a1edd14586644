// The photo's own pixels under a log ratio, without WebGL: photo/colour.py and photo/compose.py.

class Painter {
  constructor(canvas, model) {
    this.canvas = canvas;
    this.model = model;
    this.context = canvas.getContext("2d");
    this.photo = model.photo;
    this.constants = { ...model.facts.constants.colour, MOST: model.facts.constants.compose.MOST };
    this.luma = model.facts.constants.luminance;
    this.name = "canvas";
    this.layers = {};
  }

  // pixels of the person and all that does not depend on the light; `step` 2 leaves out three of four
  layer(step) {
    if (this.layers[step]) return this.layers[step];
    const { arrays, facts } = this.model, [top, bottom, left, right] = facts.window, { width } = this.photo;
    const [cover] = arrays.copy_cover, [ground] = arrays.small_ground;
    const sx = cover.width / (right - left), sy = cover.height / (bottom - top);
    const smallX = ground.width / (right - left), smallY = ground.height / (bottom - top);
    const columns = Math.ceil(width / step), found = [];
    for (let y = Math.ceil(top / step) * step; y < bottom; y += step) {
      for (let x = Math.ceil(left / step) * step; x < right; x += step) {
        const cx = (x - left + 0.5) * sx - 0.5, cy = (y - top + 0.5) * sy - 0.5;
        if (cover.at(cx, cy) > 0) found.push([x, y, cx, cy]);
      }
    }
    const layer = { columns, rows: Math.ceil(this.photo.height / step), count: found.length, index: [], x: [], y: [] };
    const names = { person: 3, rest: 3, diffuse: 3, cast: 3, highlight: 1, skin: 1, lit: 1, share: 1, follow: 1 };
    for (const [name, size] of Object.entries(names)) layer[name] = new Float32Array(found.length * size);
    for (const name of ["index", "x", "y"]) layer[name] = new Float32Array(found.length);
    const eyeball = facts.constants.person.EYEBALL;
    found.forEach(([x, y, cx, cy], k) => {
      const bx = (x - left + 0.5) * smallX - 0.5, by = (y - top + 0.5) * smallY - 0.5;
      const at = (name) => arrays[name][0].at(cx, cy), colour = (name) => arrays[name].map((map) => map.at(bx, by));
      const scene = this.model.sceneAt(x, y), seen = at("copy_cover"), behind = colour("small_ground");
      const diffuse = colour("small_diffuse"), skin = at("copy_skin");
      const person = scene.map((value, c) =>
        clamp(value - (1 - seen) * behind[c], 0, value * Math.min(this.constants.MOST * seen, 1)));
      layer.person.set(person, 3 * k);
      layer.rest.set(scene.map((value, c) => value - person[c]), 3 * k);
      layer.diffuse.set(diffuse, 3 * k);
      layer.cast.set(colour("small_cast").map((value) => Math.log(Math.max(value, 1e-4))), 3 * k);
      layer.highlight[k] = highlightOf(person, diffuse) * skin;
      layer.skin[k] = skin;
      layer.lit[k] = at("copy_lit");
      layer.share[k] = at("copy_share");
      layer.follow[k] = 1 - eyeball * at("copy_eyeballs");
      layer.index[k] = (y / step) * columns + x / step;
      [layer.x[k], layer.y[k]] = [cx, cy];
    });
    this.layers[step] = layer;
    return layer;
  }

  draw({ ratios, ratio, change, exposure, strength, step }) {
    const layer = this.layer(step), { columns, rows } = layer;
    const image = this.plain(step, columns, rows), out = image.data, logs = [0, 0, 0], relit = [0, 0, 0];
    for (let k = 0; k < layer.count; k++) {
      const [x, y] = ratio.fromCopy(layer.x[k], layer.y[k]);
      for (let c = 0; c < ratios.length; c++) {
        const value = layer.follow[k] * ratios[c].at(x, y) + exposure;
        logs[c] = value > 0 ? value * layer.share[k] : value;
      }
      if (ratios.length === 1) logs[1] = logs[2] = logs[0];
      this.relight(layer, k, logs, change, relit);
      this.display(layer, k, relit, strength, out, 4 * layer.index[k]);
    }
    this.canvas.width = columns;
    this.canvas.height = rows;
    this.context.putImageData(image, 0, 0);
  }

  plain(step, columns, rows) {
    const { data, width } = this.photo, image = new ImageData(columns, rows);
    if (step === 1) image.data.set(data);
    else {
      for (let y = 0, k = 0; y < rows; y++) {
        for (let x = 0; x < columns; x++, k += 4) {
          const from = 4 * (y * step * width + x * step);
          for (let c = 0; c < 4; c++) image.data[k + c] = data[from + c];
        }
      }
    }
    return image;
  }

  // relit_radiance of photo/colour.py, less the person's own
  relight(layer, k, logs, change, relit) {
    const { constants, luma } = this, p = 3 * k, { person, diffuse, cast } = layer, { typical } = this.model.facts;
    const [r, g, b] = [person[p], person[p + 1], person[p + 2]], skin = layer.skin[k], lit = layer.lit[k];
    const highlight = layer.highlight[k], share = constants.CAST * change * lit, body = [r - highlight, g - highlight, b - highlight];
    const level = dot(body, luma);
    for (let c = 0; c < 3; c++) body[c] *= Math.exp(-share * cast[p + c]);
    const kept = level / Math.max(dot(body, luma), 1e-6);
    for (let c = 0; c < 3; c++) body[c] *= kept;
    const most = Math.max(r, g, b), [from, to] = constants.BLOWN, warm = [-1, 0.25, 1];
    const blown = clamp((most - from) / (to - from), 0, 1) * lit * change;
    const bright = dot(body, luma);
    for (let c = 0; c < 3; c++) body[c] += blown * clamp(-2 * logs[c], 0, 1) * (bright * typical[c] - body[c]);
    const now = dot(body, luma), [low, high] = constants.LIFTED;
    let missing = 0;
    for (let c = 0; c < 3; c++) {
      const log = logs[c], darker = log < 0, ratio = Math.exp(log);
      const tint = darker ? 1 + constants.WARM * skin * warm[c] : 1;
      const ofHighlight = darker ? Math.exp(1.6 * log) : 1 + 0.35 * (ratio - 1);
      const lifted = clamp((log - low) / (high - low), 0, constants.MOST_TYPICAL) * lit;
      const added = Math.max(ratio - 1, 0) * lifted * (now * typical[c] - body[c]);
      relit[c] = Math.exp(log * tint) * body[c] + added + ofHighlight * highlight;
      missing += luma[c] * (ratio * person[p + c] - relit[c]);
    }
    const restored = constants.RESTORED * Math.max(missing, 0) * skin;
    for (let c = 0; c < 3; c++) relit[c] += restored * diffuse[p + c] - person[p + c];
  }

  // to_display of photo/colour.py
  display(layer, k, relit, strength, out, at) {
    const { KNEE, WHITEST, SHOULDER, TOE } = this.constants, p = 3 * k;
    const develop = (value) => {
      const raised = Math.max(value, 0) ** TOE;
      return ((1 + SHOULDER) * raised) / (1 + SHOULDER * raised);
    };
    let most = 0, own = 0;
    const linear = [0, 0, 0];
    for (let c = 0; c < 3; c++) {
      const scene = layer.person[p + c] + layer.rest[p + c];
      linear[c] = develop(scene + strength * relit[c]);
      most = Math.max(most, linear[c]);
      own = Math.max(own, scene);
    }
    own = develop(own);
    const base = Math.max(own, KNEE), room = Math.max(WHITEST - base, 1e-3);
    const rolled = Math.min(base + room * (1 - Math.exp(-Math.max(most - base, 0) / room)), Math.max(WHITEST, own));
    const scale = most > base ? rolled / Math.max(most, 1e-6) : 1;
    for (let c = 0; c < 3; c++) out[at + c] = Math.floor(encoded(clamp(linear[c] * scale, 0, 1)) * 255 + 0.5);
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

const encoded = (linear) => (linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055);

function highlightOf(scene, diffuse) {
  const a11 = dot(diffuse, diffuse), a12 = diffuse[0] + diffuse[1] + diffuse[2];
  const b1 = dot(scene, diffuse), b2 = scene[0] + scene[1] + scene[2];
  const determinant = Math.max(3 * a11 - a12 * a12, 1e-3);
  return clamp((a11 * b2 - a12 * b1) / determinant, 0, 0.9 * Math.min(...scene));
}

// radiance of the 256 codes
function sceneTable({ SHOULDER, TOE }) {
  return Float32Array.from({ length: 256 }, (_, code) => {
    const linear = decoded(code / 255);
    return (linear / (1 + SHOULDER - SHOULDER * linear)) ** (1 / TOE);
  });
}

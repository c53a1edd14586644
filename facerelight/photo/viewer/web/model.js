// What the page knows, and pictures of it under any light.

const COARSE = [2, 4]; // pixels of the fine grid that are one while the light moves; the second on slow machines
const SLOW = 0.07; // seconds a frame

async function loadModel(photo, data) {
  const { arrays, facts } = await unpack(data);
  await photo.decode();
  const canvas = document.createElement("canvas");
  canvas.width = photo.naturalWidth;
  canvas.height = photo.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(photo, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height);
  const scene = sceneTable(facts.constants.colour), [top, bottom, left, right] = facts.window;
  const sceneAt = (x, y) => [0, 1, 2].map((c) => scene[pixels.data[4 * (y * canvas.width + x) + c]]);
  const [exposed] = arrays.copy_exposed;
  const luminanceAt = (column, row) => {
    const x = left + Math.floor(((column + 0.5) * (right - left)) / exposed.width);
    const y = top + Math.floor(((row + 0.5) * (bottom - top)) / exposed.height);
    return dot(sceneAt(x, y), facts.constants.luminance);
  };
  return { arrays, facts, photo: pixels, sceneAt, luminanceAt };
}

class Darkroom {
  constructor(canvas, model, webgl) {
    this.model = model;
    this.grids = {};
    this.slow = false;
    this.drafts = []; // seconds
    this.painter = webgl ? anyPainter(canvas, model) : new Painter(canvas, model);
  }

  // draws; a draft is coarser where shadows end
  show({ lamps, fill, strength }, draft) {
    const started = performance.now(), coarse = draft ? COARSE[this.slow ? 1 : 0] : 1;
    const ratio = (this.grids[coarse] = this.grids[coarse] || new Ratio(this.model, coarse));
    const sources = sceneSources(lamps, fill, this.model.facts);
    const ratios = ratio.of(sources);
    const { change, exposure } = ratio.exposure(ratios);
    const step = draft && (this.slow || this.painter.name === "canvas") ? 2 : 1;
    this.painter.draw({ ratios, ratio, change, exposure, strength, step });
    if (draft) this.drafts.push((performance.now() - started) / 1000);
    if (this.drafts.length > 60) this.drafts.shift();
    const last = this.drafts.slice(-6); // the first one sets up
    if (draft && last.length > 5 && Math.min(...last) > SLOW) this.slow = true;
  }
}

function anyPainter(canvas, model) {
  try {
    return new GLPainter(canvas, model);
  } catch (error) {
    // a canvas that once was asked for WebGL may have no other context
    const fresh = canvas.cloneNode();
    canvas.replaceWith(fresh);
    return new Painter(fresh, model);
  }
}

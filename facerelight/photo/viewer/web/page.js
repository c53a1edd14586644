// The page: what is asked for, the controls that say it, and the pictures that answer.

const MOST_LAMPS = 3;
const REST = 160; // milliseconds without a change, after which the picture is drawn finely
const AROUND_FACE = 3.2; // eye distances from the face's middle to the rim of its disc
const FACE_MIDDLE = [0, -0.42];
const SLIDERS = ["azimuth", "elevation", "size", "power"];
const get = (id) => document.getElementById(id);
const facing = ({ azimuth, elevation }) => {
  const side = Math.round(Math.abs(azimuth)), high = Math.round(Math.abs(elevation));
  const across = side ? `${side}° ${azimuth > 0 ? "left" : "right"}` : "middle";
  return `${across}, ${high ? `${high}° ${elevation > 0 ? "above" : "below"}` : "level"}`;
};

class Page {
  constructor(model, darkroom, about) {
    Object.assign(this, { model, darkroom, about, selected: 0, timer: 0, pending: false });
    this.scene = structuredClone({ ...PRESETS.Loop, strength: 1 });
    this.doubt = new Dome(model.arrays.unsure_basis, model.arrays.unsure_table);
    get("frame").parentElement.parentElement.style.setProperty("--ratio", model.photo.width / model.photo.height);
    this.facePlaces();
    this.presets();
    this.sliders();
    this.ball();
    this.photo();
    this.views();
    get("said").textContent = model.facts.warnings.join(" ");
    get("busy").remove();
    this.changed();
  }

  get lamp() {
    return this.scene.lamps[this.selected];
  }

  // the bust's coordinates on the photo, 0 to 1
  facePlaces() {
    const [[a, b, e], [c, d, f]] = this.model.facts.copy_to_bust, determinant = a * d - b * c;
    const [top, bottom, left, right] = this.model.facts.window, { width, height } = this.model.photo;
    const [cover] = this.model.arrays.copy_cover, scale = [(right - left) / cover.width, (bottom - top) / cover.height];
    const toPhoto = (x, y) => {
      const u = (d * (x - e) - b * (y - f)) / determinant, v = (a * (y - f) - c * (x - e)) / determinant;
      return [(left + (u + 0.5) * scale[0]) / width, (top + (v + 0.5) * scale[1]) / height];
    };
    this.middle = toPhoto(...FACE_MIDDLE);
    const [x, y] = toPhoto(FACE_MIDDLE[0] + AROUND_FACE, FACE_MIDDLE[1]);
    this.reach = Math.hypot((x - this.middle[0]) * width, (y - this.middle[1]) * height);
    this.toPhoto = toPhoto;
    this.wipe = clamp(this.middle[0], 0.1, 0.9);
  }

  presets() {
    for (const [name, scene] of Object.entries(PRESETS)) {
      button(get("presets"), name, () => {
        Object.assign(this.scene, structuredClone(scene));
        this.selected = 0;
        this.changed(`${name}. ${this.spoken()}`);
      });
    }
  }

  sliders() {
    const bind = (id, read) => get(id).addEventListener("input", ({ target }) => {
      read(target.value);
      this.changed();
    });
    // a slider moves the way the lamp does: to the right for less azimuth
    for (const name of SLIDERS) bind(name, (value) => { this.lamp[name] = name === "azimuth" ? -value || 0 : Number(value); });
    bind("colour", (value) => { this.lamp.colour = value; });
    for (const name of ["fill", "strength"]) bind(name, (value) => { this.scene[name] = Number(value); });
    bind("wipe", (value) => { this.wipe = Number(value); });
  }

  ball() {
    const ball = get("ball"), place = (event) => {
      const box = ball.getBoundingClientRect();
      return [event.clientX, event.clientY].map((value, k) =>
        (2 * (value - (k ? box.top : box.left)) - box.width) / (box.width - 18));
    };
    dragged(ball, (event) => {
      const [x, y] = place(event), far = ({ azimuth, elevation }) => {
        const [u, v] = toDisc(azimuth, elevation);
        return Math.hypot(u - x, v - y);
      };
      const nearest = this.scene.lamps.map(far), least = Math.min(...nearest);
      if (least < 0.14) this.selected = nearest.indexOf(least);
      this.aim(...fromDisc(x, y));
    }, (event) => this.aim(...fromDisc(...place(event))));
    ball.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    ball.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    const step = event.shiftKey ? 15 : 3, moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[event.key]) this.aim(this.lamp.azimuth + moves[event.key][0], this.lamp.elevation + moves[event.key][1]);
    else if (event.key === "+" || event.key === "=") this.resize(1);
    else if (event.key === "-") this.resize(-1);
    else return;
    event.preventDefault();
    this.speak(this.spoken());
  }

  wheel(event) {
    event.preventDefault();
    this.resize(event.deltaY < 0 ? 1 : -1);
  }

  resize(steps) {
    this.lamp.size = clamp(Math.round(this.lamp.size + steps * Math.max(1, this.lamp.size / 10)), 0, 60);
    this.changed();
  }

  aim(azimuth, elevation) {
    this.lamp.azimuth = Math.round(((azimuth + 540) % 360) - 180);
    this.lamp.elevation = Math.round(clamp(elevation, -90, 90));
    this.changed();
  }

  // the lamp is where the pointer is, beside the face; on the wipe's line the line is dragged
  photo() {
    const frame = get("frame"), box = () => frame.getBoundingClientRect();
    const across = (event) => (event.clientX - box().left) / box().width;
    const wiped = (event) => {
      this.wipe = clamp(across(event), 0, 1);
      this.changed();
    };
    const lit = (event) => {
      const { left, top, width } = box(), scale = this.model.photo.width / width;
      const x = (event.clientX - left) * scale - this.middle[0] * this.model.photo.width;
      const y = (event.clientY - top) * scale - this.middle[1] * this.model.photo.height;
      this.aim(...fromDisc(x / this.reach, y / this.reach));
    };
    let move = lit;
    dragged(frame, (event) => {
      const onLine = this.comparing && Math.abs(across(event) - this.wipe) * box().width < 24;
      move = onLine ? wiped : lit;
      frame.classList.add("held");
      move(event);
    }, (event) => move(event), () => frame.classList.remove("held"));
    frame.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  views() {
    const toggle = (id, change) => get(id).addEventListener("click", ({ currentTarget }) => {
      const on = currentTarget.getAttribute("aria-pressed") !== "true";
      currentTarget.setAttribute("aria-pressed", String(on));
      change(on);
      this.changed();
    });
    toggle("compare", (on) => { this.comparing = on; });
    toggle("doubt", (on) => { this.doubting = on; });
    get("save").addEventListener("click", () => this.save());
    get("copy").addEventListener("click", async () => {
      await navigator.clipboard.writeText(get("command").textContent).catch(() => select(get("command")));
      this.speak("Copied");
    });
  }

  save() {
    this.draw(false);
    this.darkroom.painter.canvas.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${this.about.name}_relit.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
      this.speak(`Saved ${link.download}`);
    });
  }

  // everything shown follows what is asked for: at once coarsely, finely once it rests
  changed(said) {
    this.controls();
    if (said) this.speak(said);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.draw(false);
      window.dispatchEvent(new Event("lightchange"));
    }, REST);
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      if (this.fine !== JSON.stringify(this.scene)) this.draw(true);
    });
  }

  draw(draft) {
    const wanted = JSON.stringify(this.scene);
    if (!draft && this.fine === wanted) return;
    this.darkroom.show(this.scene, draft);
    this.fine = draft ? "" : wanted;
    const { painter } = this.darkroom, drafts = this.darkroom.drafts.slice(-15);
    const rate = drafts.length < 10 ? "" : `, ${Math.round(drafts.length / drafts.reduce((a, b) => a + b))} frames a second`;
    const [azimuth, elevation] = this.model.facts.source;
    const own = `The photo's own light: ${facing({ azimuth, elevation })}.`;
    get("foot").textContent = `${own} ${this.about.text} Drawn with ${painter.name}${rate}.`;
  }

  controls() {
    const { lamp, scene } = this;
    for (const name of SLIDERS) get(name).value = name === "azimuth" ? -lamp[name] : lamp[name];
    get("colour").value = lamp.colour;
    get("fill").value = scene.fill;
    get("strength").value = scene.strength;
    get("wipe").value = this.wipe;
    get("wipe-out").textContent = `${Math.round(100 * this.wipe)} %`;
    get("azimuth-out").textContent = facing({ ...lamp, elevation: 0 }).split(",")[0];
    get("elevation-out").textContent = facing(lamp).split(", ")[1];
    get("size-out").textContent = `${lamp.size}°, ${lamp.size < 3 ? "bare bulb" : lamp.size < 10 ? "reflector" : lamp.size < 25 ? "soft box" : "window"}`;
    get("power-out").textContent = `${Math.round(100 * lamp.power)} %`;
    get("fill-out").textContent = `${Math.round(100 * scene.fill)} %`;
    get("strength-out").textContent = `${Math.round(100 * scene.strength)} %`;
    for (const name of [...SLIDERS, "fill", "strength"]) {
      get(name).setAttribute("aria-valuetext", get(`${name}-out`).textContent);
    }
    for (const one of get("presets").children) {
      const { lamps, fill } = PRESETS[one.textContent], same = JSON.stringify([lamps, fill]);
      one.setAttribute("aria-pressed", String(same === JSON.stringify([scene.lamps, scene.fill])));
    }
    get("command").textContent = this.said();
    drawBall(get("ball"), scene.lamps, this.selected, scene.fill, this.model.facts.constants.luminance);
    this.lampButtons();
    this.marks();
    this.compared();
    this.overlay();
  }

  lampButtons() {
    const group = get("lamps"), { lamps } = this.scene, wanted = lamps.map(({ colour }) => colour).join() + this.selected;
    if (group.dataset.shown === wanted) return;
    const focused = document.activeElement && group.contains(document.activeElement);
    group.dataset.shown = wanted;
    group.replaceChildren();
    lamps.forEach(({ colour }, k) => {
      const one = button(group, String(k + 1), () => {
        this.selected = k;
        this.changed(this.spoken());
      });
      one.setAttribute("aria-label", `Lamp ${k + 1}`);
      one.setAttribute("aria-pressed", String(k === this.selected));
      const dot = document.createElement("span");
      dot.className = "dot";
      dot.style.setProperty("--c", colour);
      one.prepend(dot);
      if (focused && k === this.selected) one.focus();
    });
    if (lamps.length < MOST_LAMPS) plain(button(group, "Add", () => {
      lamps.push({ ...lamp(-this.lamp.azimuth || -50, 15, 10, 0.5) });
      this.selected = lamps.length - 1;
      this.changed(this.spoken());
    }), "Add a lamp");
    if (lamps.length > 1) plain(button(group, "Remove", () => {
      lamps.splice(this.selected, 1);
      this.selected = Math.max(0, this.selected - 1);
      this.changed(this.spoken());
    }), "Remove this lamp");
  }

  marks() {
    const { width, height } = this.model.photo, shown = get("marks");
    shown.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const dot = width / Math.max(shown.clientWidth, 1);
    shown.innerHTML = this.scene.lamps.map((one, k) => {
      const [x, y] = toDisc(one.azimuth, one.elevation).map((value, axis) =>
        clamp(this.middle[axis] * (axis ? height : width) + value * this.reach, 8 * dot, (axis ? height : width) - 8 * dot));
      const kind = Math.abs(one.azimuth) > 90 ? "mark behind" : "mark";
      const ring = k === this.selected ? `<circle class="ring" vector-effect="non-scaling-stroke" cx="${x}" cy="${y}" r="${11 * dot}"/>` : "";
      return `<circle class="${kind}" vector-effect="non-scaling-stroke" style="--c:${one.colour}" cx="${x}" cy="${y}" r="${7 * dot}"/>${ring}`;
    }).join("");
  }

  compared() {
    get("frame").classList.toggle("compared", Boolean(this.comparing));
    get("wipe-label").hidden = !this.comparing;
    get("before").style.clipPath = `inset(0 ${this.comparing ? 100 * (1 - this.wipe) : 100}% 0 0)`;
    get("wipe-line").style.left = `${100 * this.wipe}%`;
  }

  // amber where the model is unsure of the face under the selected lamp
  overlay() {
    const overlay = get("overlay"), { width, height } = this.model.photo;
    get("doubt-note").hidden = !this.doubting;
    overlay.style.opacity = this.doubting ? 1 : 0;
    if (!this.doubting) return;
    const { azimuth, elevation } = this.lamp, { rotation, crop_to_bust: [[scale, , x0], [, , y0]] } = this.model.facts;
    const map = this.doubt.at(inFront(fromHead(lightFromAngles(azimuth, elevation), rotation))), most = Math.max(largest(map.values), 1e-6);
    const small = document.createElement("canvas");
    small.width = map.width;
    small.height = map.height;
    const context = small.getContext("2d"), image = context.createImageData(map.width, map.height);
    map.values.forEach((value, p) => image.data.set([255, 168, 30, 230 * Math.min(value / most, 1) ** 0.8], 4 * p));
    context.putImageData(image, 0, 0);
    overlay.width = width;
    overlay.height = height;
    const at = (column, row) => {
      const [x, y] = this.toPhoto(x0 + column * scale, y0 - row * scale);
      return [x * width, y * height];
    };
    const origin = at(-0.5, -0.5), right = at(0.5, -0.5), down = at(-0.5, 0.5);
    const shown = overlay.getContext("2d");
    shown.setTransform(right[0] - origin[0], right[1] - origin[1], down[0] - origin[0], down[1] - origin[1], ...origin);
    shown.imageSmoothingQuality = "high";
    shown.drawImage(small, 0, 0);
    get("doubt-scale").textContent = `the deepest is a standard deviation of ${(100 * most).toFixed(0)} % of full light`;
  }

  // the same light for the command line
  said() {
    const { lamps, fill, strength } = this.scene;
    const words = lamps.map(({ azimuth, elevation, size, power, colour }) => [
      `--light ${azimuth},${elevation},size=${size}`, power === 1 ? "" : `,power=${power}`,
      colour === "#ffffff" ? "" : `,colour=${colour.slice(1)}`].join(""));
    const { file } = this.about, named = /^[\w./-]+$/.test(file) ? file : `'${file.replaceAll("'", "'\\''")}'`;
    return ["facerelight relight", named, ...words, `--fill ${fill}`, strength === 1 ? "" : `--strength ${strength}`]
      .filter(Boolean).join(" ");
  }

  spoken() {
    return `Lamp ${this.selected + 1} of ${this.scene.lamps.length}: ${facing(this.lamp)}, size ${this.lamp.size}°`;
  }

  speak(text) {
    get("live").textContent = text;
  }
}

function button(parent, text, act) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", act);
  parent.append(made);
  return made;
}

function plain(made, label) {
  made.className = "plain";
  made.setAttribute("aria-label", label);
}

function dragged(element, start, move, end = () => {}) {
  element.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    element.setPointerCapture(event.pointerId);
    start(event);
  });
  element.addEventListener("pointermove", (event) => {
    if (element.hasPointerCapture(event.pointerId)) move(event);
  });
  for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, end);
}

function select(element) {
  getSelection().selectAllChildren(element);
}

// `facerelight` lets another page, or a test, say what is wanted and see what was drawn
async function start(photo, data, about) {
  try {
    const model = await loadModel(photo, data);
    const darkroom = new Darkroom(get("relit"), model, !location.hash.includes("canvas"));
    const page = new Page(model, darkroom, about);
    page.draw(false);
    window.addEventListener("resize", () => page.controls());
    window.facerelight = {
      painter: darkroom.painter.name,
      get seconds() { return darkroom.drafts.slice(); },
      get scene() { return structuredClone(page.scene); },
      set(scene) {
        Object.assign(page.scene, structuredClone(scene));
        page.selected = Math.min(page.selected, page.scene.lamps.length - 1);
        page.controls();
        page.draw(false);
      },
      draft: (scene) => darkroom.show({ ...page.scene, ...scene }, true),
      picture() {
        page.draw(false);
        return darkroom.painter.canvas.toDataURL("image/png");
      },
    };
  } catch (error) {
    get("busy").textContent = `This page could not be set up: ${error.message}`;
    throw error;
  }
}

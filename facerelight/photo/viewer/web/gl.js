// The same as colour.js by WebGL2, every pixel at once.

const VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D photo, ratio, masks, eyeballs, diffuses, casts, grounds;
uniform vec4 window;               // left, top, width, height, pixels of the photo
uniform vec2 copy;                 // width, height
uniform mat3 toRatio;              // copy to the ratio's raster, 0 to 1
uniform float rows, skip, change, exposure, strength;
uniform vec3 typical;
out vec4 shown;
float most(vec3 v) { return max(max(v.r, v.g), v.b); }
vec3 decode(vec3 c) { return mix(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, lessThanEqual(c, vec3(0.04045))); }
vec3 encode(vec3 l) {
  return mix(1.055 * pow(max(l, 0.0), vec3(1.0 / 2.4)) - 0.055, 12.92 * l, lessThanEqual(l, vec3(0.0031308)));
}
vec3 develop(vec3 e) {
  vec3 raised = pow(max(e, 0.0), vec3(TOE));
  return (1.0 + SHOULDER) * raised / (1.0 + SHOULDER * raised);
}
void main() {
  vec2 pixel = (vec2(gl_FragCoord.x, rows - gl_FragCoord.y) - 0.5) * skip + 0.5; // with skip 2 one pixel of four
  vec4 own = texelFetch(photo, ivec2(pixel), 0);
  shown = vec4(own.rgb, 1.0);
  vec2 inside = (pixel - window.xy) / window.zw;
  if (any(lessThan(inside, vec2(0.0))) || any(greaterThan(inside, vec2(1.0)))) return;
  vec4 mask = texture(masks, inside);
  float cover = mask.r, skin = mask.b, lit = mask.a;
  if (cover <= 0.0) return;
  vec3 linear = decode(own.rgb);
  vec3 scene = pow(linear / (1.0 + SHOULDER - SHOULDER * linear), vec3(1.0 / TOE));
  vec3 diffuse = texture(diffuses, inside).rgb;
  vec3 person = clamp(scene - (1.0 - cover) * texture(grounds, inside).rgb, vec3(0.0), scene * min(MOST * cover, 1.0));
  vec3 logs = texture(ratio, (toRatio * vec3(inside * copy - 0.5, 1.0)).xy).rgb;
  logs = logs * (1.0 - EYEBALL * texture(eyeballs, inside).r) + exposure;
  logs *= mix(vec3(1.0), vec3(mask.g), greaterThan(logs, vec3(0.0)));
  bvec3 darker = lessThan(logs, vec3(0.0));
  vec3 times = exp(logs);
  float a11 = dot(diffuse, diffuse), a12 = dot(diffuse, vec3(1.0));
  float b1 = dot(person, diffuse), b2 = dot(person, vec3(1.0));
  float least = 0.9 * min(min(person.r, person.g), person.b);
  float highlight = skin * clamp((a11 * b2 - a12 * b1) / max(3.0 * a11 - a12 * a12, 1e-3), 0.0, least);
  vec3 body = person - highlight;
  float level = dot(body, LUMA);
  body *= exp(-CAST * change * lit * log(max(texture(casts, inside).rgb, 1e-4)));
  body *= level / max(dot(body, LUMA), 1e-6);
  float blown = clamp((most(person) - BLOWN.x) / (BLOWN.y - BLOWN.x), 0.0, 1.0) * lit * change;
  body += blown * clamp(-2.0 * logs, 0.0, 1.0) * (dot(body, LUMA) * typical - body);
  vec3 lifted = clamp((logs - LIFTED.x) / (LIFTED.y - LIFTED.x), 0.0, MOST_TYPICAL) * lit;
  vec3 added = max(times - 1.0, 0.0) * lifted * (dot(body, LUMA) * typical - body);
  vec3 tint = 1.0 + mix(vec3(0.0), WARM * skin * vec3(-1.0, 0.25, 1.0), darker);
  vec3 ofHighlight = mix(1.0 + 0.35 * (times - 1.0), exp(1.6 * logs), darker);
  vec3 relit = exp(logs * tint) * body + added + ofHighlight * highlight;
  relit += RESTORED * max(dot(times * person - relit, LUMA), 0.0) * diffuse * skin;
  vec3 now = develop(scene + strength * (relit - person));
  float brightest = most(now), before = most(develop(scene)), base = max(before, KNEE), room = max(WHITEST - base, 1e-3);
  float rolled = min(base + room * (1.0 - exp(-max(brightest - base, 0.0) / room)), max(WHITEST, before));
  if (brightest > base) now *= rolled / max(brightest, 1e-6);
  shown = vec4(encode(clamp(now, 0.0, 1.0)), 1.0);
}`;

class GLPainter {
  // throws where there is no WebGL2
  constructor(canvas, model) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL2");
    this.canvas = canvas;
    this.gl = gl;
    this.facts = model.facts;
    this.photo = model.photo;
    this.name = "WebGL2";
    this.program = program(gl, VERTEX, defined(model.facts.constants));
    gl.useProgram(this.program);
    const { arrays, facts } = model, [top, bottom, left, right] = facts.window, [cover] = arrays.copy_cover;
    this.texture(0, "photo", gl.RGBA8, model.photo.width, model.photo.height, model.photo.data, gl.NEAREST);
    const masks = ["copy_cover", "copy_share", "copy_skin", "copy_lit"].map((name) => arrays[name][0]);
    this.texture(2, "masks", gl.RGBA8, cover.width, cover.height, interleaved(masks, 4, 255));
    this.texture(3, "eyeballs", gl.R8, cover.width, cover.height, interleaved(arrays.copy_eyeballs, 1, 255));
    [["diffuses", "small_diffuse"], ["casts", "small_cast"], ["grounds", "small_ground"]].forEach(([name, maps], k) => {
      const [{ width, height }] = arrays[maps];
      this.texture(4 + k, name, gl.RGBA16F, width, height, interleaved(arrays[maps], 4, 0));
    });
    gl.uniform4f(this.place("window"), left, top, right - left, bottom - top);
    gl.uniform2f(this.place("copy"), cover.width, cover.height);
    gl.uniform3fv(this.place("typical"), facts.typical);
  }

  // as large as the photo, or half of that
  resize(step) {
    const { gl, canvas } = this, width = Math.ceil(this.photo.width / step), rows = Math.ceil(this.photo.height / step);
    if (canvas.width !== width || canvas.height !== rows) {
      canvas.width = width;
      canvas.height = rows;
    }
    gl.viewport(0, 0, width, rows);
    gl.uniform1f(this.place("rows"), rows);
    gl.uniform1f(this.place("skip"), step);
  }

  place(name) {
    return this.gl.getUniformLocation(this.program, name);
  }

  texture(number, name, format, width, height, values, filter = this.gl.LINEAR) {
    const { gl } = this, layout = format === gl.R8 ? gl.RED : gl.RGBA;
    gl.activeTexture(gl.TEXTURE0 + number);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const use of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, use, filter);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const kind = format === gl.RGBA16F ? gl.FLOAT : gl.UNSIGNED_BYTE;
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, kind, values && new (kind === gl.FLOAT ? Float32Array : Uint8Array)(values));
    gl.uniform1i(this.place(name), number);
  }

  draw({ ratios, ratio, change, exposure, strength, step }) {
    this.resize(step);
    const { gl } = this, [{ width, height }] = ratios;
    const maps = ratios.length === 1 ? [ratios[0], ratios[0], ratios[0]] : ratios;
    if (this.size !== `${width} ${height}`) {
      this.texture(1, "ratio", gl.RGBA16F, width, height, null);
      this.size = `${width} ${height}`;
    }
    gl.activeTexture(gl.TEXTURE1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT, interleaved(maps, 4, 0));
    const [x0, y0] = ratio.fromCopy(0, 0), [xx, yx] = ratio.fromCopy(1, 0), [xy, yy] = ratio.fromCopy(0, 1);
    gl.uniformMatrix3fv(this.place("toRatio"), false, [
      (xx - x0) / width, (yx - y0) / height, 0, (xy - x0) / width, (yy - y0) / height, 0,
      (x0 + 0.5) / width, (y0 + 0.5) / height, 1,
    ]);
    gl.uniform1f(this.place("change"), change);
    gl.uniform1f(this.place("exposure"), exposure);
    gl.uniform1f(this.place("strength"), strength);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// values of several maps side by side; as bytes where `scale` is given
function interleaved(maps, channels, scale) {
  const count = maps[0].values.length;
  const out = scale ? new Uint8Array(count * channels) : new Float32Array(count * channels);
  maps.forEach(({ values }, c) => {
    for (let p = 0, k = c; p < count; p++, k += channels) out[k] = scale ? Math.round(scale * values[p]) : values[p];
  });
  return out;
}

function defined({ colour, compose, person, luminance }) {
  const numbers = { ...colour, MOST: compose.MOST, EYEBALL: person.EYEBALL, LUMA: luminance };
  const text = (value) => (Number.isInteger(value) ? `${value}.0` : `${value}`);
  const lines = Object.entries(numbers).map(([name, value]) => {
    const said = Array.isArray(value) ? `vec${value.length}(${value.map(text).join(", ")})` : text(value);
    return `#define ${name} ${said}`;
  });
  return FRAGMENT.replace("precision highp float;", `${lines.join("\n")}\nprecision highp float;`);
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

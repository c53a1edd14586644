// Lamps as sums of distant points: geometry/sources.py.

const RADIANS = Math.PI / 180;
const GOLDEN_ANGLE = Math.PI * (3 - Math.sqrt(5));

function lightFromAngles(azimuth, elevation) {
  const turn = azimuth * RADIANS, rise = elevation * RADIANS, level = Math.cos(rise);
  return [-level * Math.sin(turn), Math.sin(rise), level * Math.cos(turn)];
}

function anglesFromLight([x, y, z]) {
  return [Math.atan2(-x, z) / RADIANS, Math.asin(clamp(y, -1, 1)) / RADIANS];
}

const decoded = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);

// linear, of luminance 1; black is taken for white
function linearColour(hex, luminance) {
  const linear = [1, 3, 5].map((k) => decoded(parseInt(hex.slice(k, k + 2), 16) / 255));
  const level = linear.reduce((sum, value, k) => sum + value * luminance[k], 0);
  return level > 1e-6 ? linear.map((value) => value / level) : [1, 1, 1];
}

function lampPoints(azimuth, elevation, size) {
  const count = size < 2 ? 1 : size < 8 ? 7 : size < 25 ? 13 : 24;
  const towards = lightFromAngles(azimuth, elevation);
  const up = Math.abs(towards[1]) < 0.95 ? [0, 1, 0] : [1, 0, 0];
  const across = unit(cross(up, towards)), along = cross(towards, across);
  return Array.from({ length: count }, (_, k) => {
    const angle = count > 1 ? size * RADIANS * Math.sqrt((k + 0.5) / count) : 0, turn = k * GOLDEN_ANGLE;
    const c = Math.cos(angle), a = Math.sin(angle) * Math.cos(turn), b = Math.sin(angle) * Math.sin(turn);
    return towards.map((value, axis) => c * value + a * across[axis] + b * along[axis]);
  });
}

// sources {directions, weights, size, colour}, weights of points at power 1 times the lamp's share
function sceneSources(lamps, fill, facts) {
  const sources = lamps.map((lamp) => {
    const directions = lampPoints(lamp.azimuth, lamp.elevation, lamp.size);
    const strength = (1 - fill) * lamp.power;
    const white = lamp.colour.toLowerCase() === "#ffffff";
    const colour = white ? [1, 1, 1] : linearColour(lamp.colour, facts.constants.luminance);
    const weights = directions.map(() => 1 / directions.length);
    return { directions, weights, size: lamp.size, strength, colour };
  });
  if (fill > 0) sources.push({ ...facts.fill, size: 20, strength: fill, colour: [1, 1, 1] });
  return sources;
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function unit(vector) {
  const length = Math.max(Math.hypot(...vector), 1e-12);
  return vector.map((value) => value / length);
}

// A lamp's place as a place on a disc: the angle from the camera is the distance from the middle.

const SPAN = 135; // degrees from the camera at the disc's edge

// a lamp, -1 to 1 across and down the disc
function toDisc(azimuth, elevation) {
  const [x, y, z] = lightFromAngles(azimuth, elevation), side = Math.hypot(x, y);
  const far = Math.min(Math.acos(clamp(z, -1, 1)) / RADIANS / SPAN, 1);
  return side < 1e-6 ? [z > 0 ? 0 : -far, 0] : [(far * x) / side, (-far * y) / side];
}

function fromDisc(across, down) {
  const far = Math.min(Math.hypot(across, down), 1), angle = far * SPAN * RADIANS;
  if (far < 1e-6) return [0, 0];
  const length = Math.hypot(across, down), side = Math.sin(angle) / length;
  return anglesFromLight([across * side, -down * side, Math.cos(angle)]);
}

// a white ball under the lamps, and where they stand
function drawBall(canvas, lamps, selected, fill, luminance) {
  const scale = Math.min(window.devicePixelRatio || 1, 2), size = Math.round(canvas.clientWidth * scale) || 216;
  canvas.width = canvas.height = size;
  const context = canvas.getContext("2d"), image = context.createImageData(size, size), middle = size / 2;
  const reach = (90 / SPAN) * middle;
  const lit = lamps.map(({ azimuth, elevation, size: wide, power, colour }) => ({
    towards: lightFromAngles(azimuth, elevation), soft: Math.sin(Math.min(wide, 80) * RADIANS) * 0.5,
    colour: linearColour(colour, luminance).map((value) => value * power * (1 - fill)),
  }));
  for (let row = 0, k = 0; row < size; row++) {
    for (let column = 0; column < size; column++, k += 4) {
      const x = (column + 0.5 - middle) / reach, y = (middle - row - 0.5) / reach, far = Math.hypot(x, y);
      const edge = clamp((1 - far) * reach + 0.5, 0, 1), outer = clamp((middle / reach - far) * reach + 0.5, 0, 1);
      const z = Math.sqrt(Math.max(1 - far * far, 0)), light = [0, 0, 0];
      for (const { towards, soft, colour } of lit) {
        const facing = Math.max((x * towards[0] + y * towards[1] + z * towards[2] + soft) / (1 + soft), 0);
        for (let c = 0; c < 3; c++) light[c] += facing * colour[c];
      }
      for (let c = 0; c < 3; c++) {
        const ball = 255 * encoded(clamp((light[c] + fill * (0.7 + 0.3 * y)) * 0.72 + 0.004, 0, 1));
        image.data[k + c] = edge * ball + (1 - edge) * 44;
      }
      image.data[k + 3] = 255 * outer;
    }
  }
  context.putImageData(image, 0, 0);
  lamps.forEach(({ azimuth, elevation, colour }, k) => {
    const [x, y] = toDisc(azimuth, elevation).map((value) => middle + value * (middle - 9 * scale));
    const behind = Math.abs(azimuth) > 90;
    context.lineWidth = 2 * scale;
    context.beginPath();
    context.arc(x, y, 6.5 * scale, 0, 7);
    context.fillStyle = behind ? "#000a" : colour;
    context.strokeStyle = behind ? colour : "#000c";
    context.fill();
    context.stroke();
    if (k !== selected) return;
    context.beginPath();
    context.arc(x, y, 10.5 * scale, 0, 7);
    context.strokeStyle = "#000c";
    context.lineWidth = 4 * scale;
    context.stroke();
    context.strokeStyle = "#fff";
    context.lineWidth = 2 * scale;
    context.stroke();
  });
}

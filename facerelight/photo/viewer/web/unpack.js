// Arrays of a block of bytes, as packing.py wrote them.

async function unpack(base64) {
  const raw = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const end = 4 + new DataView(raw.buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(raw.subarray(4, end)));
  const stream = new Blob([raw.subarray(end)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const body = new DataView(await new Response(stream).arrayBuffer());
  const arrays = {};
  let place = 0;
  for (const [name, entry] of Object.entries(facts.arrays)) {
    const [height, width] = entry.shape.slice(-2);
    const count = entry.shape.reduce((a, b) => a * b, 1);
    const wide = entry.bits === 16;
    const whole = entry.signed ? new Int16Array(count) : new Uint8Array(count);
    for (let k = 0; k < count; k++) {
      const column = k % width, row = ((k / width) | 0) % height;
      const left = column ? whole[k - 1] : 0, above = row ? whole[k - width] : 0;
      const corner = column && row ? whole[k - width - 1] : 0;
      whole[k] = left + above - corner + (wide ? body.getUint16(place + 2 * k, true) : body.getUint8(place + k));
    }
    place += count * (wide ? 2 : 1);
    const maps = count / (height * width);
    const values = Float32Array.from(whole, (value) => value * entry.step);
    arrays[name] = Array.from({ length: maps }, (_, k) =>
      new Raster(height, width, values.subarray(k * height * width, (k + 1) * height * width)));
  }
  return { arrays, facts };
}

"use strict";
// What the views share: the page's data, its bytes, its colours.
const report = {
  data: JSON.parse(document.getElementById("data").textContent),
  element: (name) => document.getElementById(name),

  // bytes from text in base64 that holds them deflated
  unpacked: async (text) => {
    const deflated = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([deflated]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  },

  // a number of a few digits, as the text beside has them
  short: (value, digits = 3) => {
    const size = Math.abs(value);
    const written = size && size < 1e-4 ? value.toExponential(digits - 1) : String(Number(value.toPrecision(digits)));
    return written.replace("-", "−");
  },

  // 256 colours as pixels: the map's between two of the 256 levels, its ends beyond them
  colours: (map, from = 0, to = 255) => {
    const pixels = new Uint8ClampedArray(1024);
    for (let level = 0; level < 256; level++) {
      const place = 3 * Math.round(255 * Math.min(1, Math.max(0, (level - from) / (to - from))));
      pixels.set([map[place], map[place + 1], map[place + 2], 255], 4 * level);
    }
    return new Uint32Array(pixels.buffer);
  },

  // draw an array of levels, which levelAt(row, column) gives, with one pixel for each
  draw: (canvas, height, width, levelAt, colours) => {
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    for (let row = 0, n = 0; row < height; row++)
      for (let column = 0; column < width; column++, n++) pixels[n] = colours[levelAt(row, column)];
    context.putImageData(image, 0, 0);
  },

  // a bar of 1, 2 or 5 times a power of ten in µm, at most a quarter of a picture's width
  bar: (element, width) => {
    const power = 10 ** Math.floor(Math.log10(width / 4));
    const length = [5, 2, 1].map((times) => times * power).find((one) => one <= width / 4) || power;
    element.style.width = `${(100 * length) / width}%`;
    element.firstChild.textContent = `${report.short(length)} µm`;
  },

  // what a view says, a moment after it last changed, so that a screen reader isn't interrupted at each step
  say: (name, words) => {
    clearTimeout(report.waiting[name]);
    report.waiting[name] = setTimeout(() => (report.element(name).textContent = words), 200);
  },
  waiting: {},
};

report.maps = (async () => {
  const maps = {};
  for (const [name, text] of Object.entries(report.data.maps)) maps[name] = await report.unpacked(text);
  return maps;
})();
// the views take the place of the still pictures once the first bytes are there
report.maps.then(() => {
  document.documentElement.classList.add("ready");
});

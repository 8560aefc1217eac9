"use strict";
// Measured, modelled and residual images of one focus plane and prism setting.
(async () => {
  const { images } = report.data;
  if (!images) return;
  const maps = await report.maps;
  const { element, short } = report;
  const plane = element("plane"), prism = element("prism");
  const figures = [...document.querySelectorAll("#images figure")];
  const levels = await Promise.all(images.kinds.map((kind) => report.unpacked(kind.values)));
  const [height, width] = images.size;

  function draw() {
    const p = Number(prism.value), f = Number(plane.value);
    const start = (p * images.planes.length + f) * height * width;
    images.kinds.forEach((kind, number) => {
      const figure = figures[number], canvas = figure.querySelector("canvas");
      const values = levels[number], [low, high] = kind.limits[p];
      report.draw(canvas, height, width, (row, column) => values[start + row * width + column], report.colours(maps[kind.colours]));
      canvas.setAttribute("aria-label", `${kind.name} image, prism ${images.prisms[p]}, plane ${images.planes[f]}`);
      figure.querySelector(".low").textContent = short(low);
      figure.querySelector(".high").textContent = short(high);
    });
    for (const [slider, words] of [[plane, images.planes[f]], [prism, images.prisms[p]]]) {
      slider.setAttribute("aria-valuetext", words);
      element(`${slider.id}-value`).textContent = words;
    }
    if (images.rms) report.say("images-said", `The residual is ${short(images.rms[p][f])} rms, in units of the empty bright field.`);
  }

  images.kinds.forEach((kind, number) =>
    report.draw(figures[number].querySelector(".scale canvas"), 1, 256, (row, column) => column, report.colours(maps[kind.colours])));
  const bar = document.querySelector("#images .bar");
  if (bar) report.bar(bar, images.width);
  for (const slider of [plane, prism]) slider.addEventListener("input", draw);
  draw();
})();

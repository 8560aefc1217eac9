"use strict";
// Three sections through one point of a volume.
(async () => {
  const { volumes } = report.data;
  if (!volumes.length) return;
  const maps = await report.maps;
  const { element, short } = report;
  const AXES = ["z", "y", "x"];
  // for each section: the axis across the picture, the one down it, the one that it is cut at
  const PLANES = { xy: [2, 1, 0], zy: [0, 1, 2], xz: [2, 0, 1] };
  const figures = Object.fromEntries(
    [...document.querySelectorAll("#sections figure")].map((figure) => [figure.dataset.plane, figure]));
  const sliders = AXES.map((axis) => element(`place-${axis}`));
  const from = element("from"), to = element("to"), choice = element("volume"), map = element("colours");
  const levels = await Promise.all(volumes.map((volume) => report.unpacked(volume.values)));
  let number = 0;

  const volume = () => volumes[number];
  const place = () => sliders.map((slider) => Number(slider.value));
  const valueOf = (level) => volume().low + (level / 255) * (volume().high - volume().low);
  const unit = () => (volume().unit ? ` ${volume().unit}` : "");

  // each level's colour: the map lies between the scale's ends, or, where it diverges, to both sides of 0
  function colours() {
    let [low, high] = [Number(from.value), Number(to.value)];
    if (map.value === "RdBu_r") {
      const zero = (-255 * volume().low) / (volume().high - volume().low || 1);
      const reach = Math.max(Math.abs(low - zero), Math.abs(high - zero)) || 1;
      [low, high] = [zero - reach, zero + reach];
    }
    return report.colours(maps[map.value], low, high);
  }

  function draw() {
    const { shape, places, title } = volume();
    const [nz, ny, nx] = shape;
    const at = place();
    const stride = [ny * nx, nx, 1];
    const values = levels[number];
    const colour = colours();
    for (const [name, [across, down, cut]] of Object.entries(PLANES)) {
      const start = at[cut] * stride[cut];
      const figure = figures[name], canvas = figure.querySelector("canvas");
      report.draw(canvas, shape[down], shape[across],
        (row, column) => values[start + row * stride[down] + column * stride[across]], colour);
      canvas.setAttribute("aria-label", `${title}, section ${name} at ${AXES[cut]} = ${short(places[cut][at[cut]])} µm`);
      figure.querySelector(".across").style.top = `${(100 * (at[down] + 0.5)) / shape[down]}%`;
      figure.querySelector(".down").style.left = `${(100 * (at[across] + 0.5)) / shape[across]}%`;
    }
    AXES.forEach((axis, i) => {
      const words = `${short(places[i][at[i]])} µm`;
      sliders[i].setAttribute("aria-valuetext", `${axis} ${words}, ${at[i] + 1} of ${shape[i]}`);
      element(`place-${axis}-value`).textContent = `${words} (${at[i] + 1} of ${shape[i]})`;
    });
    const level = values[at[0] * stride[0] + at[1] * stride[1] + at[2]];
    report.say("sections-said", `${title} at this point: ${short(valueOf(level))}${unit()}`);
  }

  function drawScale() {
    const low = Number(from.value), high = Number(to.value);
    report.draw(element("sections-scale"), 1, 256, (row, column) => Math.round(low + (column / 255) * (high - low)), colours());
    element("scale-low").textContent = (low > 0 ? "≤ " : "") + short(valueOf(low)) + unit();
    element("scale-high").textContent = (high < 255 ? "≥ " : "") + short(valueOf(high)) + unit();
    element("scale-name").textContent = volume().title;
    for (const [slider, level] of [[from, low], [to, high]]) {
      const words = short(valueOf(level)) + unit();
      slider.setAttribute("aria-valuetext", words);
      element(`${slider.id}-value`).textContent = words;
    }
  }

  function recolour() {
    drawScale();
    draw();
  }

  // show a volume at given voxels
  function show(chosen, at) {
    number = chosen;
    sliders.forEach((slider, axis) => {
      slider.max = volume().shape[axis] - 1;
      slider.value = at[axis];
    });
    map.value = volume().colours;
    [from.value, to.value] = volume().scale;
    recolour();
  }

  // the voxels of another volume that are nearest to those of this one
  function same(other) {
    const at = place();
    return other.places.map((places, axis) => {
      const wanted = volume().places[axis][at[axis]];
      const away = places.map((one) => Math.abs(one - wanted));
      return away.indexOf(Math.min(...away));
    });
  }

  function rescale(moved) {
    if (Number(from.value) >= Number(to.value)) {
      if (moved === from) from.value = Number(to.value) - 1;
      else to.value = Number(from.value) + 1;
    }
    recolour();
  }

  for (const slider of sliders) slider.addEventListener("input", draw);
  for (const slider of [from, to]) slider.addEventListener("input", () => rescale(slider));
  map.addEventListener("change", recolour);
  choice?.addEventListener("change", () => show(Number(choice.value), same(volumes[choice.value])));

  for (const [name, [across, down]] of Object.entries(PLANES)) {
    const frame = figures[name].querySelector(".frame");
    const point = (event) => {
      if (!event.buttons) return;
      const box = frame.getBoundingClientRect(), { shape } = volume();
      for (const [axis, part] of [[across, (event.clientX - box.left) / box.width], [down, (event.clientY - box.top) / box.height]])
        sliders[axis].value = Math.floor(part * shape[axis]); // the slider keeps it within its ends
      draw();
    };
    frame.addEventListener("pointerdown", (event) => { frame.setPointerCapture(event.pointerId); point(event); });
    frame.addEventListener("pointermove", point);
  }

  report.bar(document.querySelector("#sections .bar"), volume().extent[2]);
  show(0, volume().begin);
})();

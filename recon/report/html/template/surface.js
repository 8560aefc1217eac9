"use strict";
// Surfaces of equal Δn, which Plotly turns; it is unpacked when the view is scrolled to.
(() => {
  const { surfaces } = report.data;
  if (!surfaces) return;
  const { element, short } = report;
  const scene = element("solid"), slider = element("level");
  const COLOURS = { 1: "#2fb47c", "-1": "#4b77b8" };
  const VEIL = 0.15;
  const EYE = { x: 0.9, y: 1.3, z: 0.75 };
  const largest = Math.max(...surfaces.size);
  let eye = EYE, meshes = null;

  const message = (words) => {
    scene.innerHTML = '<p class="waiting"></p>';
    scene.firstChild.textContent = words;
  };

  function say() {
    const { level, inside } = surfaces.levels[slider.value];
    const words = `Δn ${short(level)}`;
    slider.setAttribute("aria-valuetext", words);
    element("level-value").textContent = words;
    report.say("surface-said", `Within the surface of ${words} lie ${short(inside)} µm³.`);
  }

  // numbers from their steps, each to the one that stands so far before it
  function summed(steps, apart) {
    for (let n = apart; n < steps.length; n++) steps[n] += steps[n - apart];
    return steps;
  }

  async function traces() {
    // places are counted in 65 535 parts of the box
    const place = (parts, axis) =>
      Float32Array.from({ length: parts.length / 3 }, (_, n) => (parts[3 * n + axis] / 65535 - 0.5) * surfaces.size[axis]);
    const made = [];
    for (const level of surfaces.levels) {
      const pair = [];
      for (const { sign, vertices, faces } of level.meshes) {
        const places = summed(new Uint16Array((await report.unpacked(vertices)).buffer), 3);
        const corners = summed(new Uint32Array((await report.unpacked(faces)).buffer), 1);
        const corner = (n) => corners.filter((_, index) => index % 3 === n);
        pair.push({
          type: "mesh3d", x: place(places, 0), y: place(places, 1), z: place(places, 2),
          i: corner(0), j: corner(1), k: corner(2), color: COLOURS[sign], hoverinfo: "skip",
          lighting: { ambient: 0.7, diffuse: 0.5, specular: 0.1, roughness: 0.8, fresnel: 0.4 },
          lightposition: { x: -1e5, y: -7e4, z: 0 },
        });
      }
      made.push(pair);
    }
    return made;
  }

  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();

  function layout(ink = colour("--ink"), line = colour("--line")) {
    const axis = (name, n, upside) => ({
      title: { text: `${name} (µm)` }, color: ink, gridcolor: line, zeroline: false, showspikes: false, showbackground: false,
      // y grows downward in images, and light travels toward +z
      range: upside ? [surfaces.size[n] / 2, -surfaces.size[n] / 2] : [-surfaces.size[n] / 2, surfaces.size[n] / 2],
    });
    return {
      paper_bgcolor: "rgba(0,0,0,0)", font: { color: ink, family: style.fontFamily }, showlegend: false,
      margin: { l: 0, r: 0, t: 0, b: 0 },
      scene: {
        xaxis: axis("x", 0, false), yaxis: axis("y", 1, true), zaxis: axis("z", 2, true),
        aspectmode: "manual", aspectratio: { x: surfaces.size[0] / largest, y: surfaces.size[1] / largest, z: surfaces.size[2] / largest },
        camera: { eye, center: { x: 0, y: 0, z: -0.12 } },
      },
    };
  }

  function shown() {
    const chosen = Number(slider.value);
    const veil = chosen > 0 ? meshes[0].map((mesh) => ({ ...mesh, opacity: VEIL })) : [];
    return [...meshes[chosen], ...veil];
  }

  // paper takes a picture, in dark letters: browsers don't print what a GPU has drawn
  let later = 0;
  function picture() {
    clearTimeout(later);
    later = setTimeout(async () => {
      const size = { width: scene.clientWidth, height: scene.clientHeight };
      if (!size.width) return; // being printed
      element("on-paper").src = await Plotly.toImage({ data: shown(), layout: layout("#222", "#ccc") }, { format: "png", ...size });
    }, 1000);
  }

  function draw() {
    picture();
    Plotly.react(scene, shown(), layout(), { displaylogo: false, displayModeBar: false, scrollZoom: false, responsive: true });
  }

  async function begin() {
    const probe = document.createElement("canvas");
    if (!probe.getContext("webgl2") && !probe.getContext("webgl")) {
      message("This browser shows no WebGL, which the view in three dimensions needs. The sections above show the same volume.");
      return;
    }
    message("The view is being prepared …");
    try {
      const script = document.createElement("script");
      script.textContent = new TextDecoder().decode(await report.unpacked(element("plotly").textContent));
      document.head.append(script);
      meshes = await traces();
      scene.textContent = "";
      draw();
      scene.on("plotly_relayout", () => {
        eye = scene.layout.scene.camera.eye;
        picture();
      });
      scene.dataset.drawn = "yes";
    } catch (error) {
      message(`The view in three dimensions can't be shown here (${error.message}). The sections above show the same volume.`);
    }
  }

  function turn(how) {
    if (!meshes) return;
    let { x, y, z } = eye;
    const flat = Math.hypot(x, y), angle = Math.atan2(y, x), away = Math.hypot(flat, z), height = Math.atan2(z, flat);
    const step = Math.PI / 12;
    const to = (angle, height, away) => ({
      x: away * Math.cos(height) * Math.cos(angle), y: away * Math.cos(height) * Math.sin(angle), z: away * Math.sin(height),
    });
    const limit = (h) => Math.max(-1.5, Math.min(1.5, h));
    eye = {
      left: () => to(angle + step, height, away), right: () => to(angle - step, height, away),
      up: () => to(angle, limit(height - step), away), down: () => to(angle, limit(height + step), away),
      near: () => to(angle, height, away / 1.25), far: () => to(angle, height, away * 1.25), back: () => EYE,
    }[how]();
    Plotly.relayout(scene, { "scene.camera.eye": eye });
  }

  slider.addEventListener("input", () => { say(); if (meshes) draw(); });
  for (const button of document.querySelectorAll("[data-turn]"))
    button.addEventListener("click", () => turn(button.dataset.turn));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => meshes && draw());
  say();
  report.maps.then(() => {
    const watch = new IntersectionObserver((entries) => {
      if (entries.some((entry) => entry.isIntersecting)) {
        watch.disconnect();
        begin();
      }
    }, { rootMargin: "200px" });
    watch.observe(scene);
  });
})();

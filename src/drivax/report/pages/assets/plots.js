// Plots below the player: one small chart per signal, one line per planner, and a bar at the current time.
(() => {
  "use strict";
  const ABSENT = -32768, WIDTH = 380, HEIGHT = 150, LEFT = 44, RIGHT = 8, TOP = 8, BOTTOM = 22;
  const source = document.getElementById("style"), stage = document.getElementById("stage");
  const container = document.getElementById("plots");
  if (!source || !stage || !container) return;
  const { signals, strokes } = JSON.parse(source.textContent);
  const SVG = new DOMParser().parseFromString("<svg></svg>", "text/html").body.firstChild.namespaceURI;
  let plots = [], episode = null;

  function values(text, step) {
    const view = new DataView(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
    return Array.from({ length: view.byteLength / 2 }, (_, i) => {
      const value = view.getInt16(2 * i, true);
      return value === ABSENT ? null : value * step;
    });
  }

  function draw(tag, parent, attributes, text) {
    const node = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, String(value));
    if (text !== undefined) node.textContent = text;
    return parent.appendChild(node);
  }

  const short = (value) => String(Number(value.toPrecision(2))).replace("-", "−");
  const digits = (step) => Math.round(-Math.log10(step));

  // Grid lines at multiples of a round distance (1, 2 or 5 times a power of ten), at most five.
  function grid(low, high) {
    const minimum = (high - low) / 4, power = 10 ** Math.floor(Math.log10(minimum));
    const spacing = [1, 2, 5, 10].map((factor) => factor * power).find((width) => width >= minimum);
    const first = Math.ceil(low / spacing - 1e-9), last = Math.floor(high / spacing + 1e-9);
    return Array.from({ length: last - first + 1 }, (_, i) => (first + i) * spacing);
  }

  // Limits are drawn where values come near them; otherwise they would flatten every line.
  function bounds(lines, limits) {
    const known = lines.flat().filter((value) => value !== null);
    let low = Math.min(0, ...known), high = Math.max(0, ...known);
    for (const limit of limits) {
      if (limit < 0 && low < 0.4 * limit) low = Math.min(low, 1.08 * limit);
      if (limit > 0 && high > 0.4 * limit) high = Math.max(high, 1.08 * limit);
    }
    return high - low < 1e-9 ? [low - 0.5, high + 0.5] : [low, high];
  }

  function plot(signal, lines) {
    const figure = container.appendChild(document.createElement("figure"));
    figure.className = "chart";
    const caption = figure.appendChild(document.createElement("figcaption"));
    const svg = draw("svg", figure, { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": signal.words });
    const [low, high] = bounds(lines, signal.limits), last = episode.steps - 1;
    const x = (step) => LEFT + (step / last) * (WIDTH - LEFT - RIGHT);
    const y = (value) => HEIGHT - BOTTOM - ((value - low) / (high - low)) * (HEIGHT - BOTTOM - TOP);
    for (const value of grid(low, high)) {
      draw("line", svg, { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value) });
      draw("text", svg, { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, short(value));
    }
    for (const value of signal.limits.filter((limit) => limit >= low && limit <= high)) {
      draw("line", svg, { class: "limit", x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value) });
    }
    for (const time of grid(0, last * episode.dt)) {
      draw("text", svg, { x: x(time / episode.dt), y: HEIGHT - 6, "text-anchor": "middle" }, `${short(time)} s`);
    }
    lines.forEach((line, i) => {
      let path = "", isDrawing = false;
      line.forEach((value, step) => {
        if (value !== null) path += `${isDrawing ? "L" : "M"}${x(step).toFixed(1)} ${y(value).toFixed(1)}`;
        isDrawing = value !== null;
      });
      const [stroke, dash] = strokes[i % strokes.length];
      draw("path", svg, { d: path, stroke, "stroke-dasharray": dash });
      for (const step of Object.values(episode.rollouts[i].events)) {
        const value = line[step];
        if (value === null || value === undefined) continue;
        draw("text", svg, { class: "mark", x: x(step), y: y(value) + 4, "text-anchor": "middle" }, "✕");
      }
    });
    const bar = draw("line", svg, { class: "now", y1: TOP, y2: HEIGHT - BOTTOM, x1: LEFT, x2: LEFT });
    svg.addEventListener("click", (event) => {
      const { left, width } = svg.getBoundingClientRect();
      const share = (((event.clientX - left) / width) * WIDTH - LEFT) / (WIDTH - LEFT - RIGHT);
      const scrub = document.querySelector("[data-control=scrub]");
      scrub.value = String(Math.round(share * last));
      scrub.dispatchEvent(new Event("input"));
    });
    return { signal, lines, caption, bar, x };
  }

  stage.addEventListener("episode", (event) => {
    episode = event.detail;
    container.replaceChildren();
    const read = (rollout, i) => values(rollout.signals[i], signals[i].step);
    plots = signals.map((signal, i) => [signal, episode.rollouts.map((rollout) => read(rollout, i))])
      .filter(([, lines]) => lines.flat().some((value) => value !== null))  // the log has no commands
      .map(([signal, lines]) => plot(signal, lines));
  });

  stage.addEventListener("step", (event) => {
    for (const { signal, lines, caption, bar, x } of plots) {
      bar.setAttribute("x1", x(event.detail));
      bar.setAttribute("x2", x(event.detail));
      caption.replaceChildren(`${signal.words} [${signal.unit}]`);
      lines.forEach((line, i) => {
        const note = caption.appendChild(document.createElement("small")), value = line[event.detail];
        const key = note.appendChild(document.createElement("i"));
        key.style.background = strokes[i % strokes.length][2];
        const text = value === null ? "–" : value.toFixed(digits(signal.step)).replace("-", "−");
        note.append(`${episode.rollouts[i].planner} ${text}`);
      });
    }
  });
})();

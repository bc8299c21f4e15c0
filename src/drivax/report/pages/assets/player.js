"use strict";
// Plays rollouts: one canvas per planner, all at the same time of the same scenario. Data: see player_data.py.
(() => {
  const ABSENT = -32768;
  const page = document.documentElement;
  window.addEventListener("error", (event) => { page.dataset.error = event.message; });

  const read = (node) => JSON.parse(node.textContent);
  const stored = [...document.querySelectorAll("script.episode")];
  const stage = document.getElementById("stage");
  if (!stage || !stored.length) return;
  const { themes, widths, radii, lights: LIGHTS, events: EVENTS } = read(document.getElementById("style"));
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const colour = () => themes[dark.matches ? "dark" : "light"];

  // --- Decoding ---------------------------------------------------------------------------------------------------
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  function shorts(text) {
    const view = new DataView(bytes(text).buffer);
    return Int16Array.from({ length: view.byteLength / 2 }, (_, i) => view.getInt16(2 * i, true));
  }
  const metres = (text, unit) => Float32Array.from(shorts(text), (value) => value * unit);

  function paths(layer, unit) {
    const path = new Path2D();
    const points = metres(layer.points, unit);
    let next = 0;
    for (const count of shorts(layer.counts)) {
      for (let i = 0; i < count; i++, next += 2) {
        if (i === 0) path.moveTo(points[next], points[next + 1]);
        else path.lineTo(points[next], points[next + 1]);
      }
    }
    return path;
  }

  function decode(raw) {
    const unit = raw.unit;
    const polyline = new Path2D();
    const route = metres(raw.route, unit);
    for (let i = 0; i < route.length; i += 2) polyline[i ? "lineTo" : "moveTo"](route[i], route[i + 1]);
    const boxes = (group) => ({ kind: group.kind, size: metres(group.size, unit), pose: shorts(group.pose) });
    return {
      ...raw,
      map: Object.fromEntries(raw.layers.map((name) => [name, paths(raw.map[name], unit)])),
      stops: metres(raw.stops, unit), route: polyline, goal: metres(raw.goal, unit),
      agents: boxes(raw.agents),
      parked: { ...boxes(raw.parked), seen: shorts(raw.parked.seen) },
      lights: { line: metres(raw.lights.line, unit), state: new Int8Array(bytes(raw.lights.state).buffer) },
      log: shorts(raw.log),
      rollouts: raw.rollouts.map((rollout) => (
        { ...rollout, pose: shorts(rollout.pose), speed: shorts(rollout.speed) })),
    };
  }

  // Pose at a time (in steps), interpolated; null where the agent is absent. `first` is the index of its first pose.
  function poseAt(pose, first, time, steps, unit) {
    const step = Math.min(Math.floor(time), steps - 1);
    const at = 3 * (first + step);
    if (pose[at] === ABSENT) return null;
    const [x, y, heading] = [pose[at] * unit, pose[at + 1] * unit, pose[at + 2] / 1e4];
    const fraction = time - step;
    if (fraction <= 0 || step + 1 >= steps || pose[at + 3] === ABSENT) return [x, y, heading];
    const turn = pose[at + 5] / 1e4 - heading;
    return [
      x + fraction * (pose[at + 3] * unit - x),
      y + fraction * (pose[at + 4] * unit - y),
      heading + fraction * Math.atan2(Math.sin(turn), Math.cos(turn)),
    ];
  }

  // --- Drawing (in metres; `px` is the size of a CSS pixel in metres) ---------------------------------------------
  function box(context, pose, length, width, fill, paint, line, px, dashed) {
    context.save();
    context.translate(pose[0], pose[1]);
    context.rotate(pose[2]);
    context.beginPath();
    context.rect(-length / 2, -width / 2, length, width);
    if (fill) { context.fillStyle = paint[fill]; context.fill(); }
    if (line) {
      context.setLineDash(dashed ? [4 * px, 3 * px] : []);
      context.strokeStyle = paint[line]; context.lineWidth = widths[line] * px; context.stroke();
    }
    context.restore();
  }

  function drawMap(context, episode, paint, px) {
    context.fillStyle = paint.crosswalk;
    context.fill(episode.map.crosswalk);
    for (const name of episode.layers.filter((layer) => layer !== "crosswalk")) {
      context.strokeStyle = paint[name]; context.lineWidth = widths[name] * px;
      context.stroke(episode.map[name]);
    }
    context.fillStyle = paint.stop;
    for (let i = 0; i < episode.stops.length; i += 2) {
      context.beginPath(); context.arc(episode.stops[i], episode.stops[i + 1], radii.stop, 0, 7); context.fill();
    }
    context.strokeStyle = paint.route; context.lineWidth = widths.route * px; context.setLineDash([7 * px, 5 * px]);
    context.globalAlpha = 0.75; context.stroke(episode.route);
    context.setLineDash([]); context.globalAlpha = 1;
    if (episode.goal.length) {
      context.beginPath(); context.arc(episode.goal[0], episode.goal[1], radii.goal, 0, 7); context.stroke();
    }
  }

  function drawLights(context, episode, paint, step, px) {
    const { line, state } = episode.lights;
    const lights = line.length / 4;
    for (let i = 0; i < lights; i++) {
      const name = LIGHTS[state[step * lights + i]];
      if (!name) continue;
      context.strokeStyle = paint[name]; context.lineWidth = widths[name] * px;
      context.beginPath();
      context.moveTo(line[4 * i], line[4 * i + 1]); context.lineTo(line[4 * i + 2], line[4 * i + 3]);
      context.stroke();
    }
  }

  function drawAgents(context, episode, paint, time, px) {
    const step = Math.floor(time), { agents, parked, steps, unit } = episode;
    parked.kind.forEach((kind, i) => {
      if (step < parked.seen[2 * i] || step > parked.seen[2 * i + 1]) return;
      const pose = [parked.pose[3 * i] * unit, parked.pose[3 * i + 1] * unit, parked.pose[3 * i + 2] / 1e4];
      box(context, pose, parked.size[2 * i], parked.size[2 * i + 1], kind, paint, "outline", px);
    });
    agents.kind.forEach((kind, i) => {
      const pose = poseAt(agents.pose, i * steps, time, steps, unit);
      if (pose) box(context, pose, agents.size[2 * i], agents.size[2 * i + 1], kind, paint, "outline", px);
    });
  }

  function drawEgo(context, episode, rollout, paint, time, px) {
    const { steps, unit, size: [length, width] } = episode;
    context.strokeStyle = paint.ego; context.lineWidth = widths.ego * px;
    context.beginPath();
    for (let step = 0; step <= time; step++) {
      const pose = poseAt(rollout.pose, 0, step, steps, unit);
      if (pose) context.lineTo(pose[0], pose[1]);
    }
    context.stroke();
    const logged = poseAt(episode.log, 0, time, steps, unit);
    if (logged) box(context, logged, length, width, null, paint, "log", px, true);
    const ego = poseAt(rollout.pose, 0, time, steps, unit);
    if (!ego) return;
    box(context, ego, length, width, "ego", paint, "ink", px);
    context.save();
    context.translate(ego[0], ego[1]); context.rotate(ego[2]);
    context.fillStyle = paint.outline;
    context.beginPath();
    context.moveTo(0.38 * length, 0); context.lineTo(0.05 * length, 0.32 * width);
    context.lineTo(0.05 * length, -0.32 * width); context.fill();
    context.restore();
  }

  function drawEvents(context, episode, rollout, paint, time, px) {
    for (const step of Object.values(rollout.events)) {
      const pose = step <= time ? poseAt(rollout.pose, 0, step, episode.steps, episode.unit) : null;
      if (!pose) continue;
      const reach = 9 * px;
      for (const [ink, width] of [[paint.ground, 7], [paint.mark, 3.5]]) {
        context.strokeStyle = ink; context.lineWidth = width * px;
        context.beginPath();
        context.moveTo(pose[0] - reach, pose[1] - reach); context.lineTo(pose[0] + reach, pose[1] + reach);
        context.moveTo(pose[0] - reach, pose[1] + reach); context.lineTo(pose[0] + reach, pose[1] - reach);
        context.stroke();
      }
    }
  }

  function drawScaleBar(context, paint, height, px) {
    const length = [1, 2, 5, 10, 20, 50, 100, 200].find((nice) => nice / px >= 45) || 500;
    context.strokeStyle = context.fillStyle = paint.ink;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(12, height - 18); context.lineTo(12, height - 12);
    context.lineTo(12 + length / px, height - 12); context.lineTo(12 + length / px, height - 18);
    context.stroke();
    context.font = "12px system-ui, sans-serif";
    context.fillText(`${length} m`, 18, height - 17);
  }

  // --- State and view ---------------------------------------------------------------------------------------------
  const state = { episode: null, index: 0, time: 0, playing: false, follow: true, zoom: 1, pan: [0, 0], panes: [] };

  function extent(episode) {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const pose of [episode.log, ...episode.rollouts.map((rollout) => rollout.pose)]) {
      for (let i = 0; i < pose.length; i += 3) {
        if (pose[i] === ABSENT) continue;
        for (const axis of [0, 1]) {
          low[axis] = Math.min(low[axis], pose[i + axis] * episode.unit);
          high[axis] = Math.max(high[axis], pose[i + axis] * episode.unit);
        }
      }
    }
    return { low, high };
  }

  function camera(episode, rollout, width, height) {
    if (state.follow) {
      const at = (pose) => poseAt(pose, 0, state.time, episode.steps, episode.unit);
      const ego = at(rollout.pose) || at(episode.log) || [0, 0];
      return { x: ego[0] + state.pan[0], y: ego[1] + state.pan[1], scale: (Math.min(width, height) / 70) * state.zoom };
    }
    const { low, high } = episode.extent;
    const scale = Math.min(width / (high[0] - low[0] + 30), height / (high[1] - low[1] + 30));
    const [x, y] = [0, 1].map((axis) => (low[axis] + high[axis]) / 2 + state.pan[axis]);
    return { x, y, scale: scale * state.zoom };
  }

  function drawPane(pane) {
    const { canvas, rollout } = pane, episode = state.episode, paint = colour();
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = paint.ground; context.fillRect(0, 0, width, height);
    const view = camera(episode, rollout, width, height), px = 1 / view.scale, k = ratio * view.scale;
    context.setTransform(k, 0, 0, -k, ratio * (width / 2) - k * view.x, ratio * (height / 2) + k * view.y);
    context.lineJoin = context.lineCap = "round";
    const step = Math.min(Math.floor(state.time), episode.steps - 1);
    drawMap(context, episode, paint, px);
    drawLights(context, episode, paint, step, px);
    drawAgents(context, episode, paint, state.time, px);
    drawEgo(context, episode, rollout, paint, state.time, px);
    drawEvents(context, episode, rollout, paint, state.time, px);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    drawScaleBar(context, paint, height, px);
    pane.scale = view.scale;
  }

  const seconds = (step) => `${(step * state.episode.dt).toFixed(1)} s`;

  function updateTexts() {
    const step = Math.floor(state.time);
    for (const { rollout, speed, note } of state.panes) {
      const present = rollout.pose[3 * step] !== ABSENT;
      speed.textContent = present ? `${(rollout.speed[step] / 100).toFixed(1)} m/s` : "gone";
      const past = Object.entries(rollout.events).filter(([, at]) => at <= state.time);
      note.textContent = past.map(([name, at]) => `✕ ${EVENTS[name]} at ${seconds(at)}`).join(", ");
    }
    control.scrub.value = String(step);
    stage.dispatchEvent(new CustomEvent("step", { detail: step }));
    control.clock.textContent = `${seconds(state.time)} / ${seconds(state.episode.steps - 1)}`;
  }

  let frameRequested = false;
  function redraw() {
    updateTexts();
    if (frameRequested) return;
    frameRequested = true;
    requestAnimationFrame(() => {
      frameRequested = false;
      state.panes.forEach(drawPane);
    });
  }

  // --- Controls ---------------------------------------------------------------------------------------------------
  const control = Object.fromEntries(
    [...document.querySelectorAll("[data-control]")].map((node) => [node.dataset.control, node]));
  const choices = [...document.querySelectorAll("[data-episode]")];

  function make(tag, parent, name, text) {
    const node = parent.appendChild(document.createElement(tag));
    if (name) node.className = name;
    if (text) node.textContent = text;
    return node;
  }

  function makePane(rollout) {
    const figure = make("figure", stage, "pane");
    const caption = make("figcaption", figure);
    make("b", caption, "", rollout.planner);
    make("span", caption, rollout.outcome === "success" ? "outcome good" : "outcome bad", rollout.outcome);
    const speed = make("span", caption, "speed");
    const canvas = make("canvas", figure);
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${rollout.planner}: ${rollout.outcome}`);
    const pane = { canvas, rollout, speed, note: make("p", figure, "note"), scale: 1 };
    canvas.addEventListener("pointermove", (event) => {
      if (event.pointerType !== "mouse" || !(event.buttons & 1)) return;
      state.pan[0] -= event.movementX / pane.scale; state.pan[1] += event.movementY / pane.scale;
      redraw();
    });
    canvas.addEventListener("dblclick", () => setView(state.follow));
    sizes.observe(canvas);
    return pane;
  }

  function makeTicks(episode) {
    control.ticks.replaceChildren();
    episode.rollouts.forEach((rollout) => {
      for (const [name, step] of Object.entries(rollout.events)) {
        const tick = make("i", control.ticks);
        tick.style.setProperty("--at", String(step / (episode.steps - 1)));
        tick.title = `${rollout.planner}: ${EVENTS[name]} at ${seconds(step)}`;
      }
    });
  }

  function open(index) {
    state.index = (index + stored.length) % stored.length;
    const episode = (state.episode = decode(read(stored[state.index])));
    episode.extent = extent(episode);
    sizes.disconnect();
    stage.replaceChildren();
    stage.dataset.panes = String(episode.rollouts.length);
    state.panes = episode.rollouts.map(makePane);
    control.scrub.max = String(episode.steps - 1);
    control.title.textContent = episode.title;
    makeTicks(episode);
    choices.forEach((choice, i) => choice.setAttribute("aria-pressed", String(i === state.index)));
    state.time = Math.min(...episode.rollouts.map((rollout) => rollout.start));
    page.dataset.panes = String(state.panes.length);
    stage.dispatchEvent(new CustomEvent("episode", { detail: episode }));
    setView(state.follow);
  }

  function setView(follow) {
    Object.assign(state, { follow, zoom: 1, pan: [0, 0] });
    control.follow.setAttribute("aria-pressed", String(follow));
    control.fit.setAttribute("aria-pressed", String(!follow));
    redraw();
  }

  function zoom(factor) {
    state.zoom = Math.min(12, Math.max(0.15, state.zoom * factor));
    redraw();
  }

  function seek(time) {
    state.time = Math.min(Math.max(time, 0), state.episode.steps - 1);
    redraw();
  }

  const step = (by) => { play(false); seek(Math.floor(state.time) + by); };

  let previousMs = 0;
  function play(on) {
    if (on === state.playing) return;
    state.playing = on;
    control.play.textContent = on ? "❚❚" : "▶";
    control.play.setAttribute("aria-label", on ? "pause" : "play");
    if (!on) return;
    if (state.time >= state.episode.steps - 1) state.time = 0;
    previousMs = performance.now();
    requestAnimationFrame(advance);
  }

  function advance(nowMs) {
    if (!state.playing) return;
    seek(state.time + (Math.max(0, nowMs - previousMs) / 1000 / state.episode.dt) * Number(control.speed.value));
    previousMs = nowMs;
    if (state.time >= state.episode.steps - 1) play(false);
    else requestAnimationFrame(advance);
  }

  function faster(by) {
    const menu = control.speed;
    menu.selectedIndex = Math.min(Math.max(menu.selectedIndex + by, 0), menu.options.length - 1);
  }

  const keys = {
    " ": () => play(!state.playing), k: () => play(!state.playing),
    ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => seek(0), End: () => seek(Infinity),
    "[": () => faster(-1), "]": () => faster(1), "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8),
    f: () => setView(!state.follow), n: () => open(state.index + 1), p: () => open(state.index - 1),
  };

  function visible() {
    const { top, bottom } = stage.getBoundingClientRect();
    return bottom > 0 && top < window.innerHeight;
  }

  document.addEventListener("keydown", (event) => {
    const widget = event.target.closest("button, select, input, summary, a, .scroll");
    const isHandled = widget && (event.key === " " || widget.matches("select, input, .scroll"));
    if (!keys[event.key] || isHandled || event.ctrlKey || event.metaKey || event.altKey || !visible()) return;
    event.preventDefault();
    keys[event.key]();
  });

  const sizes = new ResizeObserver(redraw);
  control.play.addEventListener("click", () => play(!state.playing));
  control.back.addEventListener("click", () => step(-1));
  control.forward.addEventListener("click", () => step(1));
  control.scrub.addEventListener("input", () => { play(false); seek(Number(control.scrub.value)); });
  control.follow.addEventListener("click", () => setView(true));
  control.fit.addEventListener("click", () => setView(false));
  control.closer.addEventListener("click", () => zoom(1.25));
  control.wider.addEventListener("click", () => zoom(0.8));
  choices.forEach((choice, index) => choice.addEventListener("click", () => open(index)));
  dark.addEventListener("change", redraw);
  open(0);
})();

// The list of all episodes: sorting, filtering, and links from cells of tables to their episodes.
(() => {
  "use strict";
  const source = document.getElementById("list");
  if (!source) return;
  const data = JSON.parse(source.textContent), form = document.getElementById("filters").elements;
  const rows = document.getElementById("rows"), heads = document.getElementById("heads");
  const more = document.getElementById("more"), count = document.getElementById("count");
  const players = [...document.querySelectorAll("[data-episode]")];
  const FIRST = 50, MORE = 200;
  const state = { matches: [], drawn: 0, sort: -1, reversed: false };
  const kindMetric = data.metrics.findIndex((metric) => metric.name === "collision_type");

  function make(tag, parent, text, name) {
    const node = parent.appendChild(document.createElement(tag));
    if (text !== undefined) node.textContent = text;
    if (name) node.className = name;
    return node;
  }

  // --- Filters ----------------------------------------------------------------------------------------------------
  function fill(menu, first, words) {
    menu.replaceChildren();
    if (first) make("option", menu, first).value = "";
    words.forEach(([value, text]) => { make("option", menu, text).value = String(value); });
  }

  const run = () => data.runs[Number(form.run.value)];
  const metrics = data.metrics.map((metric, i) => [i, metric.label]);
  fill(form.run, null, data.runs.map((evaluation, i) => [i, evaluation.name]));
  fill(form.failed, "any", metrics.filter(([i]) => data.metrics[i].bad !== null));
  fill(form.metric, "none", metrics);
  const tags = data.tags.map((tag) => {
    const label = make("label", document.getElementById("tags"), `${tag.name} `);
    const menu = make("select", label);
    fill(menu, "any", tag.words.map((word, i) => [i, word]));
    return menu;
  });

  function outcomes() {
    fill(form.outcome, "any", run().outcomes.map((word, i) => [i, word]));
  }

  function filtered() {
    const { values, scenario, outcome } = run();
    const tests = [];
    const require = (menu, test) => { if (menu.value !== "") tests.push(test(Number(menu.value))); };
    require(form.outcome, (code) => (row) => outcome[row] === code);
    require(form.failed, (i) => (row) => values[i][row] === data.metrics[i].bad);
    tags.forEach((menu, i) => require(menu, (code) => (row) => data.tags[i].of[scenario[row]].includes(code)));
    const bound = parseFloat(form.bound.value), compare = {
      ge: (value) => value >= bound, le: (value) => value <= bound, eq: (value) => value === bound,
    }[form.sign.value];
    require(form.metric, (i) => (row) => {
      const value = values[i][row];
      return value !== null && (Number.isNaN(bound) || compare(value));
    });
    const words = form.words.value.trim().toLowerCase();
    if (words) tests.push((row) => data.scenarios[scenario[row]].toLowerCase().includes(words));
    return scenario.map((_, row) => row).filter((row) => tests.every((test) => test(row)));
  }

  // Worst first, or best first when reversed.
  const ascending = () => (data.metrics[state.sort].better === "low") === state.reversed;

  // Undefined values come last in either direction; without a column the list stays worst first.
  function sorted(matches) {
    if (state.sort < 0) return matches;
    const column = run().values[state.sort], sign = ascending() ? 1 : -1;
    return matches.sort((a, b) => {
      if (column[a] === null || column[b] === null) return (column[a] === null) - (column[b] === null) || a - b;
      return sign * (column[a] - column[b]) || a - b;
    });
  }

  // --- Drawing ----------------------------------------------------------------------------------------------------
  function columns() {
    const extra = [form.metric, form.failed].map((menu) => menu.value).filter((value) => value !== "").map(Number);
    if (state.sort >= 0) extra.push(state.sort);
    return [...data.shown, ...new Set(extra.filter((i) => !data.shown.includes(i)))];
  }

  function drawHeads() {
    heads.replaceChildren();
    for (const text of ["scenario", "outcome"]) make("th", heads, text).scope = "col";
    for (const i of columns()) {
      const head = make("th", heads), isSorted = state.sort === i;
      const sign = !isSorted ? "" : ascending() ? " ▲" : " ▼";
      head.scope = "col";
      head.setAttribute("aria-sort", !isSorted ? "none" : ascending() ? "ascending" : "descending");
      const button = make("button", head, data.metrics[i].label + sign, "plain");
      button.type = "button";
      button.title = "sort, worst first; again: best first; again: as at first";
      button.addEventListener("click", () => sort(i));
    }
  }

  function text(value, metric) {
    if (value === null) return "–";
    if (metric.unit === "rate") return value ? "yes" : "no";
    return String(Number.isInteger(value) ? value : value.toPrecision(3)).replace("-", "−");
  }

  function drawRow(row) {
    const { scenario, outcome, outcomes: words, values, playable, errors } = run();
    const line = make("tr", rows), head = make("th", line), number = scenario[row];
    head.scope = "row";
    const player = playable ? players[data.played[number]] : undefined;
    if (player) {
      const button = make("button", head, `▶ ${data.scenarios[number]}`, "plain");
      button.type = "button";
      button.title = "play this episode";
      button.addEventListener("click", () => play(player));
    } else make("span", head, data.scenarios[number]);
    make("small", head, data.tags.map((tag) => tag.words[tag.of[number]])
      .filter((word) => word !== "unknown").slice(0, 4).join(" · "));
    const cell = make("td", line, words[outcome[row]], words[outcome[row]] === "success" ? "good" : "bad");
    if (errors[row]) cell.title = `step ${errors[row][0]}: ${errors[row][1]}`;
    for (const i of columns()) {
      const metric = data.metrics[i], value = values[i][row];
      make("td", line, text(value, metric), metric.bad !== null && value === metric.bad ? "bad" : "");
    }
  }

  function draw(most) {
    state.matches.slice(state.drawn, state.drawn + most).forEach(drawRow);
    state.drawn = Math.min(state.drawn + most, state.matches.length);
    const left = state.matches.length - state.drawn;
    more.hidden = !left;
    more.textContent = `${Math.min(left, MORE)} more of ${left}`;
  }

  function list() {
    state.matches = sorted(filtered());
    state.drawn = 0;
    rows.replaceChildren();
    drawHeads();
    draw(FIRST);
    count.textContent = `${state.matches.length} of ${run().scenario.length} episodes of ${run().name}`;
    document.documentElement.dataset.matches = String(state.matches.length);
  }

  function sort(i) {
    if (state.sort !== i) Object.assign(state, { sort: i, reversed: false });
    else if (!state.reversed) state.reversed = true;
    else Object.assign(state, { sort: -1, reversed: false });
    const focused = [...heads.children].findIndex((head) => head.contains(document.activeElement));
    list();
    heads.children[focused]?.querySelector("button")?.focus();
  }

  function play(player) {
    player.click();
    document.getElementById("stage").scrollIntoView({ block: "center" });
  }

  // --- From a table to the list -----------------------------------------------------------------------------------
  function clear(runIndex) {
    form.run.form.reset();
    form.run.value = String(runIndex);
    outcomes();
    Object.assign(state, { sort: -1, reversed: false });
  }

  function show(link) {
    clear(data.runs.findIndex((evaluation) => evaluation.name === link.run));
    for (const [name, word] of Object.entries(link.tags || {})) {
      const i = data.tags.findIndex((tag) => tag.name === name);
      if (i >= 0) tags[i].value = String(data.tags[i].words.indexOf(word));
    }
    if (link.kind !== undefined) {
      form.metric.value = String(kindMetric); form.sign.value = "eq"; form.bound.value = String(link.kind);
    }
    const i = data.metrics.findIndex((metric) => metric.name === link.metric);
    if (i >= 0 && data.metrics[i].bad !== null) form.failed.value = String(i);
    else if (i >= 0) state.sort = i;
    list();
    const first = state.matches.find((row) => run().playable && players[data.played[run().scenario[row]]]);
    if (first !== undefined) players[data.played[run().scenario[first]]].click();
    else if (players.length && state.matches.length) count.textContent += `. ${missing()}`;
    document.getElementById("episodes").scrollIntoView();
    form.failed.focus({ preventScroll: true });
  }

  // The player goes on showing another episode, which is not in the list.
  function missing() {
    return run().playable ? "None of these plays in this page: --episodes N packs more episodes, --video ID draws a video"
      : "None of these plays in this page: they cannot be paired with the policy's episodes";
  }

  document.querySelectorAll("[data-link]").forEach((node) => {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "plain";
    button.title = "show the episodes of this number";
    const number = node.querySelector("b");
    number.replaceWith(button);
    button.append(number);
    button.addEventListener("click", () => show(JSON.parse(node.dataset.link)));
  });

  form.run.addEventListener("change", outcomes);
  form.run.form.addEventListener("input", list);
  form.all.addEventListener("click", () => { clear(form.run.value); list(); });
  more.addEventListener("click", () => draw(MORE));
  clear(data.runs.length - 1);
  list();
})();

// The list next to the player: shows the facts of the selected scenario, filters, and keeps its number in the address.
(() => {
  "use strict";
  const choices = [...document.querySelectorAll("[data-episode]")];
  const facts = [...document.getElementById("details").children];
  const filter = document.getElementById("filter"), shown = document.getElementById("shown");

  function showFacts() {
    const now = choices.findIndex((choice) => choice.getAttribute("aria-pressed") === "true");
    facts.forEach((fact, i) => { fact.hidden = i !== now; });
    if (now < 0) return;
    choices[now].scrollIntoView({ block: "nearest", inline: "nearest" });
    history.replaceState(null, "", `#${now + 1}`);
  }

  function applyFilter() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    choices.forEach((choice) => { choice.hidden = !words.every((word) => choice.dataset.words.includes(word)); });
    shown.textContent = `${choices.filter((choice) => !choice.hidden).length} of ${choices.length}`;
  }

  const linked = choices[Number(location.hash.slice(1)) - 1];
  if (linked) linked.click();
  const watch = new MutationObserver(showFacts);
  choices.forEach((choice) => watch.observe(choice, { attributes: true, attributeFilter: ["aria-pressed"] }));
  filter.addEventListener("input", applyFilter);
  applyFilter();
  showFacts();
})();

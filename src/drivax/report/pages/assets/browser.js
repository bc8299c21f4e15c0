// The list beside the player: shows the facts of the scenario that plays, filters, and keeps its number in the address.
(() => {
  "use strict";
  const choices = [...document.querySelectorAll("[data-episode]")];
  const facts = [...document.getElementById("details").children];
  const filter = document.getElementById("filter"), shown = document.getElementById("shown");

  function follow() {
    const now = choices.findIndex((choice) => choice.getAttribute("aria-pressed") === "true");
    facts.forEach((fact, i) => { fact.hidden = i !== now; });
    if (now < 0) return;
    choices[now].scrollIntoView({ block: "nearest", inline: "nearest" });
    history.replaceState(null, "", `#${now + 1}`);
  }

  function sift() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    choices.forEach((choice) => { choice.hidden = !words.every((word) => choice.dataset.words.includes(word)); });
    shown.textContent = `${choices.filter((choice) => !choice.hidden).length} of ${choices.length}`;
  }

  const wanted = choices[Number(location.hash.slice(1)) - 1];
  if (wanted) wanted.click();
  const watch = new MutationObserver(follow);
  choices.forEach((choice) => watch.observe(choice, { attributes: true, attributeFilter: ["aria-pressed"] }));
  filter.addEventListener("input", sift);
  sift();
  follow();
})();

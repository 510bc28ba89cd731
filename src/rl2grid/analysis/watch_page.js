"use strict";
// The page: one moment of time, the maps, the charts, and what is said about it.

const at = id => document.getElementById(id);

function made(tag, parent, attributes = {}, words = "") {
  const node = document.createElement(tag);
  Object.assign(node, attributes);
  if (words) node.textContent = words;
  parent.appendChild(node);
  return node;
}

// Percent: from here on heuristics hand over to the agent.
const ALARM = 95;

// Loadings of the series end at 255%.
function percentOf(loading) { return loading === 255 ? "255% or more" : `${loading}%`; }

class Page {
  constructor(episodes, data) {
    Object.assign(this, { episodes, colours: data.colours, grid: data.grid, chosen: 0, step: 0, round: Infinity });
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.last = Math.max(...episodes.map(episode => episode.last));
    this.axis = this.last + 1;
    this.view = new View(this.grid.centres);
    this.makeMaps();
    this.makeCharts();
    this.makeTools();
    this.makeControls();
    this.choose(0);
    this.layOut(episodes.length > 1 ? "all" : "0");
    this.show(this.stepOfAddress());
  }

  get episode() { return this.episodes[this.chosen]; }

  stepOfAddress() {
    const named = Number(location.hash.slice(1));
    return Number.isInteger(named) ? Math.max(0, Math.min(this.last, named)) : 0;
  }

  makeMaps() {
    this.maps = this.episodes.map((episode, k) => {
      const figure = made("figure", at("maps"), { className: "map" }), caption = made("figcaption", figure);
      made("b", caption, {}, episode.label);
      const state = made("span", caption);
      caption.addEventListener("click", () => this.choose(k));
      const svg = svgNode("svg", figure, { role: "img", "aria-label": `The grid, played by ${episode.label}` });
      const map = new GridMap(svg, episode, this.colours, this.view, thing => { this.choose(k); this.select(thing); });
      return Object.assign(map, { figure, state });
    });
    this.tabs = this.episodes.length < 2 ? [] : this.episodes.map((episode, k) => {
      const tab = made("button", at("tabs"), { title: episode.label }, episode.label);
      tab.addEventListener("click", () => this.choose(k));
      return tab;
    });
  }

  makeCharts() {
    const place = at("timeline"), seek = step => { this.pause(); this.show(step); };
    const tell = step => this.tooltip(step);
    const add = (name, words, paint) => {
      const label = made("div", place, { className: `words ${name}` });
      label.innerHTML = words;
      const canvas = made("canvas", place, { className: name });
      canvas.setAttribute("aria-label", name);
      return Object.assign(new Chart(canvas, this.axis, seek, tell, paint), { label });
    };
    this.loadings = this.episodes.map(episode => {
      const paint = (...to) => paintLoading(episode, this.shades, this.thing, this.axis)(...to);
      const chart = add("loading", "<b></b><br><span></span>", paint);
      chart.label.firstChild.textContent = episode.label;
      return chart;
    });
    // Demand and weather are the same for all: those of whoever lives longest are known longest.
    const longest = this.longest = this.episodes.reduce((best, each) => each.steps > best.steps ? each : best);
    this.mix = add("mix", "", (...to) => paintMix(this.episode, longest, this.axis)(...to));
    this.weather = add("weather", "", (...to) => paintWeather(this.episode, longest, this.axis)(...to));
    this.charts = [...this.loadings, this.mix, this.weather];
    addEventListener("resize", () => { this.arrange(); this.repaint(); });
    this.dark.addEventListener("change", () => { this.repaint(); this.draw(); });
  }

  repaint() { for (const chart of this.charts) chart.repaint(); }

  // What is said of a step that the mouse points at.
  tooltip(step) {
    const worst = this.episodes.filter(each => step < each.steps).map(each => `${each.label}: ${percentOf(each.loadingAt(each.worstAt(step), step))}`);
    return [`${this.episode.time(step)}, step ${step}`, ...worst].join("\n");
  }

  get shades() { return this.colours[this.dark.matches ? "dark" : "light"]; }

  makeTools() {
    for (const { kind, number, name } of thingsOf(this.grid)) made("option", at("things"), { value: `${kind} ${number} (${name})` });
    at("search").addEventListener("input", event => this.select(findThing(this.grid, event.target.value), true));
    at("names").addEventListener("change", event => { for (const map of this.maps) map.label(event.target.value); });
    at("flows").addEventListener("click", () => this.toggleFlows());
    at("in").addEventListener("click", () => this.view.zoom(1.5));
    at("out").addEventListener("click", () => this.view.zoom(1 / 1.5));
    at("fit").addEventListener("click", () => this.view.fit());
    if (this.episodes.length < 2) return;
    at("layout").hidden = false;
    made("option", at("layout"), { value: "all" }, "Side by side");
    this.episodes.forEach((episode, k) => made("option", at("layout"), { value: k }, episode.label));
    at("layout").addEventListener("change", event => this.layOut(event.target.value));
  }

  makeControls() {
    this.slider = at("slider");
    this.slider.max = this.last;
    at("previous").addEventListener("click", () => this.toEvent(-1));
    at("next").addEventListener("click", () => this.toEvent(1));
    this.slider.addEventListener("input", () => { this.pause(); this.show(+this.slider.value); });
    at("play").addEventListener("click", () => this.timer ? this.pause() : this.play());
    at("earlier").addEventListener("click", () => { this.pause(); this.show(this.step, Math.max(0, this.episode.round - 1)); });
    at("later").addEventListener("click", () => { this.pause(); this.show(this.step, this.episode.round + 1); });
    addEventListener("keydown", event => this.key(event));
    addEventListener("hashchange", () => this.show(this.stepOfAddress()));
  }

  // Shows all maps, or that of one agent.
  layOut(which) {
    at("layout").value = which;
    this.maps.forEach((map, k) => { map.figure.hidden = which !== "all" && +which !== k; });
    if (which !== "all") this.choose(+which);
    this.arrange();
  }

  // Maps beside or below each other, whichever shows them larger.
  arrange() {
    const place = at("maps"), shown = this.maps.filter(map => !map.figure.hidden).length, { width, height } = this.view.whole;
    const sizeIn = columns => Math.min(place.clientWidth / columns / width, (place.clientHeight / Math.ceil(shown / columns) - 30) / height);
    let best = 1;
    for (let columns = 2; columns <= shown; columns++) if (sizeIn(columns) > sizeIn(best)) best = columns;
    place.style.gridTemplateColumns = `repeat(${best}, minmax(0, 1fr))`;
    for (const map of this.maps) map.frame();
  }

  // The agent of whom the panel tells.
  choose(k) {
    const changed = this.told !== k;
    this.chosen = this.told = k;
    this.maps.forEach((map, j) => map.figure.classList.toggle("chosen", j === k));
    this.tabs.forEach((tab, j) => tab.setAttribute("aria-pressed", j === k));
    if (!changed) return;
    this.makeLog();
    this.repaint();
    this.show(this.step);
  }

  makeLog() {
    at("log").replaceChildren();
    this.entries = this.episode.log().map(([step, kind, words]) => {
      const entry = made("button", at("log"), { className: kind });
      made("small", entry, {}, `step ${step}, ${this.episode.time(step)} · ${kind.replace("agent end", "end")}`);
      entry.append(document.createElement("br"), words);
      entry.addEventListener("click", () => { this.pause(); this.show(step, kind === "trip" ? 0 : Infinity); });
      return entry;
    });
  }

  show(step, round = Infinity) {
    this.step = step;
    this.round = round;
    for (const episode of this.episodes) episode.seek(step, round);
    this.slider.value = step;
    this.draw();
  }

  draw() {
    for (const map of this.maps) {
      map.draw(this.dark.matches);
      this.tellState(map);
    }
    for (const chart of this.charts) chart.mark(this.step);
    this.tellTime();
    this.tellTotals();
    this.tellNow();
    this.tellWhy();
    this.tellThing();
    this.markLog();
  }

  tellTime() {
    const { episode } = this, rounds = episode.step === this.step ? episode.rounds(episode.step) : 1;
    at("clock").textContent = `${episode.time(this.step)} · step ${this.step} of ${episode.length}`;
    at("rounds").className = rounds > 1 ? "shown" : "";
    at("round").textContent = `${Math.min(episode.round + 1, rounds)} of ${rounds}`;
    at("earlier").disabled = episode.round === 0;
    at("later").disabled = episode.round === rounds - 1;
  }

  tellState(map) {
    const { episode, state } = map, over = this.step > episode.last, worst = episode.worst();
    const lost = episode.step === episode.steps && !episode.hasFlow;
    const ended = episode.isLost ? `game over at step ${episode.last}` : `ends at step ${episode.last}`;
    state.textContent = over || lost ? ended : `worst: ${percentOf(episode.loading(worst))} on line ${worst}`;
    state.className = lost || (over && episode.isLost) || (!over && episode.loading(worst) > 100) ? "alarm" : "";
    const bar = this.loadings[this.maps.indexOf(map)].label.lastChild;
    bar.textContent = over || lost ? ended : `worst loading ${percentOf(episode.loading(worst))}`;
  }

  tellTotals() {
    const { episode, longest } = this, { totals } = episode, isOver = this.step > episode.last;
    const produced = totals.kinds.map(kind => [kind, isOver ? "–" : episode.total(kind).toFixed(0)]);
    this.fillLabel(this.mix.label, `demand ${longest.total("demand").toFixed(0)} MW`, " (line)", produced);
    const weather = totals.weather.map((kind, k) => {
      const share = Math.round(100 * longest.total(`${kind} available`) / totals.capacity[k]);
      const cut = isOver ? 0 : episode.total(`${kind} available`) - episode.total(kind);
      return [kind, `${share}%${cut > 1 ? `, curtailed ${cut.toFixed(0)} MW` : ""}`];
    });
    this.fillLabel(this.weather.label, "weather", ", share of capacity", weather);
  }

  fillLabel(label, name, note, items) {
    label.replaceChildren();
    made("b", label, {}, name);
    label.append(note, document.createElement("br"));
    for (const [kind, words] of items) {
      const item = made("span", label);
      made("i", item).style.background = KIND_COLOURS[kind] ?? OTHER_COLOUR;
      item.append(`${kind} ${words}`);
      label.append(" ");
    }
  }

  // What happens in this very step.
  tellNow() {
    const { episode } = this, place = at("now"), here = episode.step === this.step;
    place.replaceChildren();
    if (!here) { made("p", place, {}, `${episode.label}: ${episode.ending}`); return; }
    const isLastRound = episode.round === episode.rounds(this.step) - 1;
    const events = episode.log().filter(([step, kind]) => step === this.step && !["trip", "agent"].includes(kind) && (isLastRound || kind !== "end"));
    for (const [, kind, words] of events) made("p", place, {}, `${kind === "heuristic" ? "The heuristic: " : ""}${words}`);
    const rounds = episode.cascadeAt.get(this.step);
    if (rounds) this.tellRound(place, rounds);
  }

  tellRound(place, rounds) {
    const { episode } = this, now = rounds[episode.round], before = rounds[episode.round - 1];
    made("h2", place, {}, `Cascade, ${episode.round + 1} of ${rounds.length}`);
    for (const trip of before?.trips ?? []) made("p", place, {}, `Before: ${episode.tripInWords(trip)}.`);
    for (const trip of now.trips) made("p", place, {}, `Now: ${episode.tripInWords(trip)}.`);
    if (!now.rho) made("p", place, {}, "No power flow is left. Production and demand are those of the step before.");
    else if (!now.trips.length) made("p", place, {}, "Nothing more trips.");
  }

  tellWhy() {
    const { episode } = this, place = at("why"), number = this.reasonNow();
    if (this.whyTold === `${this.chosen} ${number} ${episode.step}`) return;
    this.whyTold = `${this.chosen} ${number} ${episode.step}`;
    place.replaceChildren();
    if (number < 0) {
      made("p", place, { className: "note" }, "The agent was not asked yet, or the grid was safe whenever it was.");
      return;
    }
    this.explain(place, episode.reasons[number]);
  }

  // The decision that led here; else one that is taken now; else the last one.
  reasonNow() {
    const { episode } = this, before = episode.reasonBefore(episode.step), now = episode.reasonBefore(episode.step + 1);
    const justDecided = before >= 0 && episode.reasons[before].step === episode.step - 1;
    return justDecided || episode.step === episode.steps ? before : now;
  }

  explain(place, reason) {
    const { episode } = this, ago = episode.step - reason.step;
    const when = ago === 0 ? "decides now" : ago === 1 ? "has just decided" : `decided ${ago} steps ago`;
    made("h2", place, {}, `Why: the agent ${when} (step ${reason.step})`);
    const before = episode.worstAt(reason.step);
    const loading = episode.loadingAt(before, reason.step);
    made("p", place, {}, `Before: ${percentOf(loading)} on line ${before}${loading < ALARM ? ": the grid is safe" : ""}.`);
    this.tabulate(place, reason);
    const rule = episode.words[reason.why];
    if (rule) made("p", place, {}, `Its rule: ${rule}.`);
    made("p", place, {}, this.outcome(reason));
    this.tellChanges(place, reason.step);
    const preference = reason.preference && !this.saysLoading(reason) ? ` ${reason.preference}: what the agent says.` : "";
    const unknown = reason.alternatives.some(([, promised]) => promised === null) ? " –: not legal, or not known." : "";
    made("p", place, { className: "note" }, `Forecast: worst loading of the next step before protections act, of the best of ${reason.tried} actions, of doing nothing and of what was played.${unknown}${preference}`);
  }

  tellChanges(place, step) {
    const { episode } = this, changed = step + 1 < episode.steps ? episode.changedMost(step, 4) : [];
    if (!changed.length) return;
    const percent = loading => loading ? `${loading}%` : "out";
    const words = changed.map(([line, before, after]) => `line ${line} from ${percent(before)} to ${percent(after)}`);
    made("p", place, {}, `Changed most: ${words.join(", ")}.`);
  }

  // What the decision led to.
  outcome(reason) {
    const { episode } = this, next = reason.step + 1;
    if (next >= episode.steps) return episode.isLost ? "After: the game is over." : "After: the recording ends.";
    const after = episode.worstAt(next);
    return `After: ${episode.loadingAt(after, next)}% on line ${after}.`;
  }

  saysLoading(reason) { return reason.preference === "worst loading"; }

  tabulate(place, reason) {
    const table = made("table", place), head = made("tr", made("thead", table)), body = made("tbody", table);
    const own = reason.preference && !this.saysLoading(reason);
    for (const heading of ["alternative", "forecast", ...(own ? [reason.preference] : [])]) made("th", head, {}, heading);
    const playedFirst = [...reason.alternatives].sort((a, b) => b[3] - a[3]);
    for (const [words, promised, preference, chosen] of playedFirst) {
      const row = made("tr", body, { className: chosen ? "chosen" : "" });
      made("td", row, {}, `${chosen ? "✓ " : ""}${this.episode.words[words] || "do nothing"}`);
      made("td", row, {}, promised === null ? "–" : promised === "lost" ? "lost" : `${Math.round(promised)}%`);
      if (own) made("td", row, {}, preference === null ? "–" : preference.toPrecision(2));
    }
  }

  select(thing, bringIntoView = false) {
    this.thing = thing;
    for (const map of this.maps) map.highlight(thing);
    for (const chart of this.loadings) chart.repaint();
    if (thing && bringIntoView) { const [x, y] = placeOf(this.grid, thing); this.view.show(x, -y); }
    this.tellThing();
  }

  tellThing() {
    const place = at("found"), { thing, episode } = this;
    place.replaceChildren();
    if (!thing) return;
    made("h2", place, {}, `${thing.kind} ${thing.number} (${thing.name ?? this.nameOf(thing)})`);
    made("p", place, {}, this.stateOf(thing, episode));
  }

  nameOf({ kind, number }) { return (kind === "line" ? this.grid.lineNames : this.grid.subNames)[number]; }

  stateOf({ kind, number }, episode) {
    const { grid } = this;
    if (kind === "line") {
      const [origin, extremity] = grid.lines[number], [from, to] = episode.runsForward(number) ? [origin, extremity] : [extremity, origin];
      if (!episode.isOn(number)) return `Between substations ${origin} and ${extremity}; ${episode.outage(number)}. Its loading is the line in the chart below.`;
      return `From substation ${from} to ${to}: ${episode.loading(number)}%. Its loading is the line in the chart below.`;
    }
    if (kind !== "substation") {
      const symbol = grid.symbols.findIndex(each => each.kind === kind && each.number === number), { element, detail } = grid.symbols[symbol];
      return `${detail} at substation ${grid.elementSub[element]}, busbar ${episode.topology[element]}: ${episode.megawatts(symbol).toFixed(0)} MW.`.trim();
    }
    const on = busbar => grid.elementSub.filter((sub, element) => sub === number && episode.topology[element] === busbar).length;
    return on(2) ? `Split: ${on(1)} elements on busbar 1, ${on(2)} on busbar 2.` : `${on(1)} elements, all on busbar 1.`;
  }

  // The entry of the log that this moment belongs to is in view.
  markLog() {
    const story = this.episode.log();
    let current = -1;
    while (current + 1 < story.length && story[current + 1][0] <= this.step) current++;
    if (current === this.marked && this.markedOf === this.chosen) return;
    this.entries[this.marked]?.classList.remove("current");
    this.entries[current]?.classList.add("current");
    const list = at("log"), entry = this.entries[current];
    list.scrollTop = entry ? entry.offsetTop - list.clientHeight / 2 : 0;
    [this.marked, this.markedOf] = [current, this.chosen];
  }

  toggleFlows() {
    const shown = at("flows").getAttribute("aria-pressed") !== "true";
    at("flows").setAttribute("aria-pressed", shown);
    for (const layer of document.querySelectorAll(".flows")) layer.classList.toggle("hidden", !shown);
  }

  // One step, or within a cascade one round, of the agent who is looked at.
  forwards(by) {
    const { episode } = this, rounds = episode.rounds(episode.step);
    if (by === 1 && this.step === episode.step && episode.round < rounds - 1) return this.show(this.step, episode.round + 1);
    const step = Math.min(this.last, this.step + by);
    if (step === this.step) return;
    this.show(step, this.cascadeBetween(step) ? 0 : Infinity);
  }

  backwards(by) {
    if (by === 1 && this.step === this.episode.step && this.episode.round > 0) return this.show(this.step, this.episode.round - 1);
    this.show(Math.max(0, this.step - by));
  }

  // The next thing that happened, or the one before.
  toEvent(direction) {
    this.pause();
    const { episode } = this;
    if (direction > 0 && episode.step === this.step && episode.round < episode.rounds(this.step) - 1) return this.show(this.step, episode.round + 1);
    const steps = episode.log().map(([step]) => step);
    const step = direction > 0 ? steps.find(each => each > this.step) : steps.findLast(each => each < this.step);
    if (step !== undefined) this.show(step, direction > 0 && this.cascadeBetween(step) ? 0 : Infinity);
  }

  cascadeBetween(step) { return this.episodes.some(episode => episode.rounds(step) > 1 && step <= episode.last); }

  key(event) {
    if (event.target.matches("input:not([type=range]), select") || event.ctrlKey || event.metaKey || event.altKey) return;
    const by = event.shiftKey ? 12 : 1;
    const does = {
      " ": () => this.timer ? this.pause() : this.play(),
      ArrowRight: () => { this.pause(); this.forwards(by); },
      ArrowLeft: () => { this.pause(); this.backwards(by); },
      PageDown: () => { this.pause(); this.forwards(12); },
      PageUp: () => { this.pause(); this.backwards(12); },
      Home: () => { this.pause(); this.show(0); },
      End: () => { this.pause(); this.show(this.last); },
      "+": () => this.view.zoom(1.5),
      "-": () => this.view.zoom(1 / 1.5),
      0: () => this.view.fit(),
      f: () => this.toggleFlows(),
      n: () => this.toEvent(1),
      p: () => this.toEvent(-1),
      "/": () => at("search").focus(),
    }[event.key];
    if (!does) return;
    event.preventDefault();
    does();
  }

  play() {
    if (this.step === this.last) this.show(0);
    at("play").textContent = "Pause";
    this.timer = setInterval(() => {
      this.forwards(+at("speed").value);
      if (this.step === this.last && this.episode.round === this.episode.rounds(this.episode.step) - 1) this.pause();
    }, 80);
  }

  pause() {
    clearInterval(this.timer);
    this.timer = 0;
    at("play").textContent = "Play";
  }
}

const data = JSON.parse(at("episode").textContent);
if (typeof DecompressionStream === "undefined") at("now").textContent = "This page needs a browser of 2023 or later.";
else loadEpisodes(data).then(episodes => { window.page = new Page(episodes, data); });

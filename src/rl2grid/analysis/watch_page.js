"use strict";
// Decodes an episode and says what the grid looks like at a step; what draws it on the page is below.

function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return bytes;
}

class Episode {
  constructor(data) {
    Object.assign(this, data);
    this.rho = bytesOf(data.rho);
    this.power = bytesOf(data.power);
    this.nLine = data.grid.lines.length;
    this.nSymbol = data.grid.symbols.length;
    this.step = -1;
    this.seek(0);
  }

  // Changes are replayed: forwards from where we are, backwards from the beginning.
  seek(step) {
    if (this.step < 0 || step < this.step) {
      this.topology = this.grid.elementSub.map(() => 1);
      this.next = 0;
    }
    for (; this.next < this.changes.length && this.changes[this.next][0] <= step; this.next++) {
      const moved = this.changes[this.next][1];
      for (let k = 0; k < moved.length; k += 2) this.topology[moved[k]] = moved[k + 1];
    }
    this.step = step;
  }

  loading(line, step = this.step) { return this.rho[step * this.nLine + line]; }

  worst(step) {
    let best = 0;
    for (let line = 1; line < this.nLine; line++) if (this.loading(line, step) > this.loading(best, step)) best = line;
    return best;
  }

  megawatts(symbol) { return this.largest * (this.power[this.step * this.nSymbol + symbol] / 255) ** 2; }

  within(intervals, line) { return intervals.some(([l, from, to]) => l === line && from <= this.step && this.step < to); }

  isOn(line) { const [, , origin, extremity] = this.grid.lines[line]; return this.topology[origin] > 0 && this.topology[extremity] > 0; }

  splitSubstations() {
    const split = new Set();
    this.topology.forEach((busbar, element) => { if (busbar === 2) split.add(this.grid.elementSub[element]); });
    return split;
  }

  // Where an element ends at its substation, and the point before: round the end of the busbar in between.
  end(element, split) {
    const sub = this.grid.elementSub[element], [x, y] = this.grid.centres[sub];
    if (!split.has(sub)) return [[x, y], [x, y]];
    const [bar, gap] = [0.3, 0.19], [tx, ty] = this.grid.towards[element];
    const above = this.topology[element] === 2 ? -1 : 1, side = tx >= 0 ? 1 : -1;
    const behind = ty * above < -0.25;
    const along = (behind ? 0.92 * side : Math.max(-0.92, Math.min(0.92, 1.1 * tx))) * bar;
    const end = [x + along, y + above * gap];
    return [end, behind ? [x + side * (bar + 0.1), y - above * gap] : end];
  }

  lineCourse(line, split) {
    const [, , origin, extremity] = this.grid.lines[line], [near, far] = this.grid.middles[line];
    const [a, b] = this.end(origin, split), [z, y] = this.end(extremity, split);
    return [a, b, near, far, y, z];
  }

  decisionBefore(step) {
    let found = -1;
    for (let k = 0; k < this.decisions.length && this.decisions[k][0] < step; k++) if (this.decisions[k][1]) found = k;
    return found;
  }

  time(step) {
    const when = new Date(Date.parse(this.began + "Z") + step * 300000);
    return when.toLocaleString("en-GB", { timeZone: "UTC", weekday: "short", day: "2-digit", month: "short", hour: "2-digit", minute: "2-digit" });
  }
}

class Page {
  constructor(episode) {
    this.episode = episode;
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.build();
    this.dark.addEventListener("change", () => this.show(this.episode.step));
    addEventListener("resize", () => this.show(this.episode.step));
    addEventListener("keydown", event => this.key(event));
    const last = episode.steps - 1;
    this.slider = this.at("slider");
    this.slider.max = last;
    this.slider.addEventListener("input", () => { this.pause(); this.show(+this.slider.value); });
    this.at("play").addEventListener("click", () => this.timer ? this.pause() : this.play());
    this.at("strip").addEventListener("click", event => {
      const box = this.at("strip").getBoundingClientRect();
      this.show(Math.round((event.clientX - box.left) / box.width * last));
    });
    const named = +location.hash.slice(1);
    this.show(Number.isInteger(named) ? Math.max(0, Math.min(last, named)) : 0);
  }

  at(id) { return document.getElementById(id); }

  svg(tag, parent, attributes = {}) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const name in attributes) node.setAttribute(name, attributes[name]);
    parent.appendChild(node);
    return node;
  }

  titled(tag, parent, attributes) {
    const node = this.svg(tag, parent, attributes);
    node.label = this.svg("title", node);
    return node;
  }

  build() {
    const { grid } = this.episode, map = this.at("map");
    const [x, y] = [0, 1].map(axis => grid.centres.map(centre => centre[axis]));
    const [left, right, low, high] = [Math.min(...x) - 0.9, Math.max(...x) + 0.9, Math.min(...y) - 0.9, Math.max(...y) + 0.9];
    map.setAttribute("viewBox", `${left} ${-high} ${right - left} ${high - low}`);
    this.lines = grid.lines.map(() => this.titled("polyline", map, { class: "line" }));
    this.stubs = grid.symbols.map(() => this.svg("polyline", map, { class: "stub" }));
    this.bars = this.svg("path", map, { class: "bar" });
    this.discs = grid.centres.map(([cx, cy]) => this.svg("circle", map, { class: "disc", cx, cy: -cy, r: 0.21 }));
    this.symbols = grid.symbols.map(([, kind]) => this.titled("path", map, { class: kind }));
    grid.centres.forEach(([cx, cy], sub) => {
      this.svg("text", map, { x: cx, y: -cy + 0.075, "font-size": sub > 99 ? 0.16 : 0.22 }).textContent = sub;
    });
    this.entries = this.episode.decisions.map(([step, words]) => {
      if (!words) return null;
      const entry = document.createElement("button");
      entry.innerHTML = "<small></small> <span></span>";
      entry.firstChild.textContent = `step ${step + 1}, ${this.episode.time(step + 1)}`;
      entry.lastChild.textContent = words;
      entry.addEventListener("click", () => { this.pause(); this.show(Math.min(step + 1, this.episode.steps - 1)); });
      this.at("decisions").appendChild(entry);
      return entry;
    });
  }

  show(step) {
    const { episode } = this, { grid } = episode;
    episode.seek(step);
    const split = episode.splitSubstations(), colours = episode.colours[this.dark.matches ? "dark" : "light"];
    const points = list => list.map(([x, y]) => `${x.toFixed(3)},${(-y).toFixed(3)}`).join(" ");
    this.lines.forEach((node, line) => {
      const on = episode.isOn(line), loading = episode.loading(line);
      const why = episode.within(episode.attacked, line) ? "attacked" : episode.within(episode.maintained, line) ? "maintenance" : "out";
      node.setAttribute("points", points(episode.lineCourse(line, split)));
      node.setAttribute("class", on ? "line" : `line off ${why}`);
      node.style.stroke = on ? colours[Math.min(loading, colours.length - 1)] : "";
      node.style.strokeWidth = 0.045 * (0.9 + 0.9 * Math.min(loading / 100, 1));
      node.label.textContent = `line ${line} (${grid.lineNames[line]}): ${on ? loading + "%" : why}`;
    });
    this.symbols.forEach((node, symbol) => {
      const [element, kind, x, y, name] = grid.symbols[symbol], share = episode.power[step * episode.nSymbol + symbol] / 255;
      const r = 0.12 * (0.5 + 1.1 * share), [end, before] = episode.end(element, split);
      this.stubs[symbol].setAttribute("points", points([end, before, [x, y]]));
      node.setAttribute("d", outline(kind, x, -y, r));
      node.label.textContent = `${kind} ${name}: ${episode.megawatts(symbol).toFixed(0)} MW`;
    });
    this.discs.forEach((node, sub) => { node.style.display = split.has(sub) ? "none" : ""; });
    this.bars.setAttribute("d", [...split].map(sub => {
      const [x, y] = grid.centres[sub];
      return `M${x - 0.3} ${-y - 0.19}h.6M${x - 0.3} ${-y + 0.19}h.6`;
    }).join(""));
    this.tell(step);
    this.drawStrip(step);
  }

  tell(step) {
    const { episode } = this, worst = episode.worst(step), ended = step === episode.steps - 1;
    this.slider.value = step;
    this.at("clock").textContent = episode.time(step);
    this.at("step").textContent = `${step} of ${episode.length}`;
    this.at("worst").textContent = `${episode.loading(worst)}% on line ${worst}`;
    const latest = episode.decisionBefore(step);
    this.at("action").textContent = latest < 0 ? "nothing so far" : `${episode.decisions[latest][1]} (step ${episode.decisions[latest][0] + 1})`;
    this.at("ending").textContent = ended ? episode.ending : "";
    this.entries.forEach((entry, k) => { if (entry) entry.className = k === latest ? "current" : ""; });
    if (latest >= 0 && this.shown !== latest) {
      const list = this.at("decisions");
      list.scrollTop = this.entries[latest].offsetTop - list.offsetTop - list.clientHeight / 2;
    }
    this.shown = latest;
  }

  drawStrip(step) {
    const canvas = this.at("strip"), { episode } = this, width = canvas.clientWidth, height = canvas.clientHeight;
    const colours = episode.colours[this.dark.matches ? "dark" : "light"];
    if (this.peaks === undefined) {
      this.peaks = Array.from({ length: episode.steps }, (_, k) => episode.loading(episode.worst(k), k));
    }
    const ratio = devicePixelRatio || 1, pen = canvas.getContext("2d");
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    pen.scale(ratio, ratio);
    for (let x = 0; x < width; x++) {
      const from = Math.floor(x / width * episode.steps), to = Math.max(from + 1, Math.floor((x + 1) / width * episode.steps));
      let peak = 0;
      for (let k = from; k < to; k++) peak = Math.max(peak, this.peaks[k]);
      pen.fillStyle = colours[Math.min(peak, colours.length - 1)];
      pen.fillRect(x, height - Math.min(peak, 150) / 150 * height, 1, height);
    }
    pen.fillStyle = getComputedStyle(document.body).color;
    pen.fillRect(0, height / 3, width, 1);
    for (const [at, words] of episode.decisions) if (words) pen.fillRect(at / episode.steps * width, 0, 1.5, 6);
    pen.fillRect(step / Math.max(1, episode.steps - 1) * width - 1, 0, 2.5, height);
  }

  key(event) {
    const move = { ArrowLeft: -1, ArrowRight: 1, PageUp: -12, PageDown: 12 }[event.key] * (event.shiftKey ? 12 : 1);
    if (event.key === " ") { event.preventDefault(); this.timer ? this.pause() : this.play(); }
    if (Number.isNaN(move)) return;
    event.preventDefault();
    this.pause();
    this.show(Math.max(0, Math.min(this.episode.steps - 1, this.episode.step + move)));
  }

  play() {
    if (this.episode.step === this.episode.steps - 1) this.show(0);
    this.at("play").textContent = "Pause";
    this.timer = setInterval(() => {
      const step = Math.min(this.episode.step + +this.at("speed").value, this.episode.steps - 1);
      this.show(step);
      if (step === this.episode.steps - 1) this.pause();
    }, 80);
  }

  pause() {
    clearInterval(this.timer);
    this.timer = 0;
    this.at("play").textContent = "Play";
  }
}

function outline(kind, x, y, r) {
  if (kind === "load") return `M${x - r} ${y - 0.75 * r}h${2 * r}L${x} ${y + r}Z`;
  if (kind === "storage") return `M${x - 0.85 * r} ${y - 0.85 * r}h${1.7 * r}v${1.7 * r}h${-1.7 * r}Z`;
  const wave = `M${x - 0.6 * r} ${y}q${0.3 * r} ${-0.7 * r} ${0.6 * r} 0t${0.6 * r} 0`;
  return `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z${wave}`;
}

if (typeof document === "undefined") module.exports = { Episode, outline };
else new Page(new Episode(JSON.parse(document.getElementById("episode").textContent)));

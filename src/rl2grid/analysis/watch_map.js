"use strict";
// Draws a grid as the moment of an episode shows it; zooms, pans, names and highlights.

function outline(kind, x, y, r) {
  if (kind === "load") return `M${x - r} ${y - 0.75 * r}h${2 * r}L${x} ${y + r}Z`;
  if (kind === "storage") return `M${x - 0.85 * r} ${y - 0.85 * r}h${1.7 * r}v${1.7 * r}h${-1.7 * r}Z`;
  const wave = `M${x - 0.6 * r} ${y}q${0.3 * r} ${-0.7 * r} ${0.6 * r} 0t${0.6 * r} 0`;
  return `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z${wave}`;
}

function svgNode(tag, parent, attributes = {}) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const name in attributes) node.setAttribute(name, attributes[name]);
  parent.appendChild(node);
  return node;
}

// Sets what has changed: most of a map stays as it is from step to step.
function put(node, name, value) {
  const text = String(value), last = node.last ??= {};
  if (last[name] === text) return;
  last[name] = text;
  node.setAttribute(name, text);
}

// The part of the plane that maps show; all maps of a page show the same.
class View {
  constructor(centres) {
    const [x, y] = [0, 1].map(axis => centres.map(centre => centre[axis]));
    const [left, right, low, high] = [Math.min(...x) - 0.9, Math.max(...x) + 0.9, Math.min(...y) - 0.9, Math.max(...y) + 0.9];
    this.whole = { x: left, y: -high, width: right - left, height: high - low };
    this.box = { ...this.whole };
    this.watchers = [];
  }

  get isWhole() { return this.box.width > 0.999 * this.whole.width; }

  set(box) {
    this.box = box;
    for (const watcher of this.watchers) watcher();
  }

  fit() { this.set({ ...this.whole }); }

  // Makes everything `factor` times as large and keeps a point where it is.
  zoom(factor, x = this.box.x + this.box.width / 2, y = this.box.y + this.box.height / 2) {
    const { box, whole } = this, width = Math.max(whole.width / 30, Math.min(whole.width, box.width / factor));
    const share = width / box.width;
    if (width >= whole.width) return this.fit();
    this.set({ x: x - (x - box.x) * share, y: y - (y - box.y) * share, width, height: box.height * share });
  }

  pan(dx, dy) {
    const { box, whole } = this, clamp = (value, low, high) => Math.max(low, Math.min(high, value));
    const x = clamp(box.x + dx, whole.x - box.width / 2, whole.x + whole.width - box.width / 2);
    const y = clamp(box.y + dy, whole.y - box.height / 2, whole.y + whole.height - box.height / 2);
    this.set({ ...box, x, y });
  }

  show(x, y) {
    const width = Math.min(this.box.width, this.whole.width / 2.5), height = width * this.whole.height / this.whole.width;
    this.set({ x: x - width / 2, y: y - height / 2, width, height });
  }
}

class GridMap {
  constructor(svg, episode, colours, view, select) {
    Object.assign(this, { svg, episode, colours, view, select });
    this.fingers = new Map();
    this.build();
    this.listen();
    view.watchers.push(() => this.frame());
    this.frame();
  }

  layer(name) { return svgNode("g", this.svg, { class: name }); }

  titled(tag, parent, attributes, thing) {
    const node = svgNode(tag, parent, attributes);
    node.label = svgNode("title", node);
    node.addEventListener("click", () => { if (!this.dragged) this.select(thing); });
    return node;
  }

  build() {
    const { grid } = this.episode;
    this.switched = svgNode("path", this.svg, { class: "switched" });
    this.halo = svgNode("polyline", this.svg, { class: "halo" });
    this.haloDisc = svgNode("circle", this.svg, { class: "halo disc", r: 0 });
    const layers = ["lines", "stubs", "flows", "bars", "discs", "symbols", "numbers", "crosses", "names"];
    const [lines, stubs, flows, bars, discs, symbols, numbers, crosses, names] = layers.map(name => this.layer(name));
    this.beside = parallels(grid.lines);
    this.lines = grid.lines.map((_, line) => this.titled("polyline", lines, { class: "line" }, { kind: "line", number: line }));
    this.stubs = grid.symbols.map(() => svgNode("polyline", stubs, { class: "stub" }));
    this.flows = grid.lines.map(() => svgNode("path", flows, { d: "M-.055 -.06L.075 0L-.055 .06Z" }));
    this.bars = svgNode("path", bars, { class: "bar" });
    this.discs = grid.centres.map(([cx, cy], sub) =>
      this.titled("circle", discs, { class: "disc", cx, cy: -cy, r: 0.21 }, { kind: "substation", number: sub }));
    this.discs.forEach((node, sub) => { node.label.textContent = `substation ${sub} (${grid.subNames[sub]})`; });
    this.symbols = grid.symbols.map(each => this.titled("path", symbols, { class: each.kind }, each));
    grid.centres.forEach(([cx, cy], sub) => {
      svgNode("text", numbers, { x: cx, y: -cy + 0.075, "font-size": sub > 99 ? 0.16 : 0.22 }).textContent = sub;
    });
    this.crosses = svgNode("path", crosses, { class: "cross" });
    this.names = names;
  }

  // Names on the map: "", "numbers" or "names".
  label(kind) {
    const { grid } = this.episode, { names } = this;
    names.replaceChildren();
    if (!kind) return;
    const text = (x, y, words, size) => {
      svgNode("text", names, { x, y: -y, style: `font-size:calc(${size}px * var(--letters))` }).textContent = words;
    };
    grid.middles.forEach((middle, line) => {
      const [x, y] = between(middle, this.beside[line] ? 0.7 : 0.3);
      text(x, y - 0.05, kind === "numbers" ? line : grid.lineNames[line], 0.15);
    });
    grid.symbols.forEach(({ kind: what, number, name, x, y }) => text(x, y - 0.26, kind === "numbers" ? `${what[0]}${number}` : name, 0.12));
    if (kind === "names") grid.centres.forEach(([x, y], sub) => text(x, y + 0.25, grid.subNames[sub], 0.12));
  }

  highlight(thing) {
    this.highlighted = thing;
    this.drawHalo();
  }

  drawHalo() {
    const { grid } = this.episode, thing = this.highlighted;
    put(this.halo, "points", thing?.kind === "line" ? this.lines[thing.number].last.points : "");
    const at = thing && thing.kind !== "line" ? placeOf(grid, thing) : null;
    put(this.haloDisc, "r", at ? (thing.kind === "substation" ? 0.36 : 0.27) : 0);
    if (at) { put(this.haloDisc, "cx", at[0]); put(this.haloDisc, "cy", -at[1]); }
  }

  draw(dark) {
    const { episode } = this, split = episode.splitSubstations(), colours = this.colours[dark ? "dark" : "light"];
    const moved = this.drawn !== episode.topology;
    this.drawn = episode.topology;
    this.lines.forEach((node, line) => this.drawLine(node, line, split, colours, moved));
    this.symbols.forEach((node, symbol) => this.drawSymbol(node, symbol, split, moved));
    if (moved) this.drawSubstations(split);
    this.drawCutOff();
    this.drawSwitched();
    this.drawHalo();
  }

  // Rings round what was switched in this step.
  drawSwitched() {
    const { episode } = this, { lines, subs } = episode.switched();
    const ring = ([x, y], r) => `M${x - r} ${-y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z`;
    const rings = [...subs.map(sub => ring(episode.grid.centres[sub], 0.45)), ...lines.map(line => ring(between(episode.grid.middles[line], 0.5), 0.2))];
    put(this.switched, "d", rings.join(""));
  }

  drawLine(node, line, split, colours, moved) {
    const { episode } = this, on = episode.isOn(line), loading = episode.loading(line), why = on ? "" : episode.outage(line);
    const unknown = on && !episode.hasFlow;
    if (moved) put(node, "points", pointsOf(episode.lineCourse(line, split)));
    put(node, "class", on ? (unknown ? "line unknown" : "line") : `line off ${why}`);
    const width = 0.045 * (0.9 + 0.9 * Math.min(loading / 100, 1.3)), known = on && !unknown;
    const colour = known ? `stroke:${colours[Math.min(loading, colours.length - 1)]};` : "";
    put(node, "style", `${colour}stroke-width:calc(${(known ? width : 0.05).toFixed(3)}px * var(--thick))`);
    const state = on ? (unknown ? "no power flow" : `${loading}%`) : why;
    node.label.textContent = `${episode.lineName(line)}: ${state}`;
    this.drawFlow(line, on && !unknown && loading > 1);
  }

  drawFlow(line, flows) {
    const node = this.flows[line], { episode } = this;
    put(node, "visibility", flows ? "visible" : "hidden");
    if (!flows) return;
    const [near, far] = episode.grid.middles[line], [from, to] = this.directionOf(line, near, far);
    const [x, y] = between([near, far], 0.5);
    const angle = Math.atan2(-(to[1] - from[1]), to[0] - from[0]) * 180 / Math.PI;
    put(node, "transform", `translate(${x.toFixed(3)} ${(-y).toFixed(3)}) rotate(${angle.toFixed(1)})`);
  }

  directionOf(line, near, far) {
    const { grid } = this.episode, [origin, extremity] = grid.lines[line];
    const ends = [grid.centres[origin], grid.centres[extremity]];
    const short = Math.hypot(far[0] - near[0], far[1] - near[1]) < 0.05;
    const pair = short ? ends : [near, far];
    return this.episode.runsForward(line) ? pair : [pair[1], pair[0]];
  }

  drawSymbol(node, symbol, split, moved) {
    const { episode } = this, { element, kind, x, y, name, number, detail } = episode.grid.symbols[symbol];
    const r = 0.12 * (0.5 + 1.1 * episode.share(symbol));
    if (moved) put(this.stubs[symbol], "points", pointsOf([...episode.end(element, split), [x, y]]));
    put(node, "d", outline(kind, x, -y, +r.toFixed(4)));
    node.label.textContent = `${detail} ${kind} ${number} (${name}): ${episode.megawatts(symbol).toFixed(0)} MW`.trim();
  }

  drawSubstations(split) {
    this.discs.forEach((node, sub) => put(node, "display", split.has(sub) ? "none" : "inline"));
    put(this.bars, "d", [...split].map(sub => {
      const [x, y] = this.episode.grid.centres[sub];
      return `M${x - 0.3} ${-y - 0.19}h.6M${x - 0.3} ${-y + 0.19}h.6`;
    }).join(""));
  }

  // A cross on every generator, load or substation that the end of the episode left without a grid.
  drawCutOff() {
    const { grid } = this.episode, lost = new Set(this.episode.cutOff());
    const places = grid.symbols.filter(each => lost.has(each.element)).map(({ x, y }) => [x, y, 0.2]);
    put(this.crosses, "d", places.map(([x, y, r]) => `M${x - r} ${-y - r}l${2 * r} ${2 * r}m0 ${-2 * r}l${-2 * r} ${2 * r}`).join(""));
  }

  frame() {
    const { x, y, width, height } = this.view.box;
    this.svg.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
    // On a small picture of a large grid, lines and names are drawn larger than to scale.
    const unit = width / Math.max(1, this.svg.clientWidth), larger = (factor, most) => Math.max(1, Math.min(most, factor * unit)).toFixed(2);
    this.svg.style.setProperty("--thick", larger(30, 2.2));
    this.svg.style.setProperty("--letters", larger(60, 2));
    // Where all is in view, a finger scrolls the page; else it moves the map.
    this.svg.style.touchAction = this.view.isWhole ? "pan-y" : "none";
  }

  // From pixels of the screen to the plane of the map.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [point.x, point.y];
  }

  listen() {
    const { svg, fingers } = this;
    svg.addEventListener("wheel", event => {
      event.preventDefault();
      this.view.zoom(Math.exp(-event.deltaY / 400), ...this.at(event));
    }, { passive: false });
    svg.addEventListener("dblclick", event => this.view.zoom(2, ...this.at(event)));
    svg.addEventListener("pointerdown", event => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      this.dragged = false;
    });
    svg.addEventListener("pointermove", event => this.drag(event));
    for (const name of ["pointerup", "pointercancel", "pointerleave"]) svg.addEventListener(name, event => fingers.delete(event.pointerId));
  }

  drag(event) {
    const { fingers } = this, before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], scale = 1 / this.svg.getScreenCTM().a;
    if (Math.hypot(now[0] - before[0], now[1] - before[1]) > 3) this.dragged = true;
    if (!this.dragged) return;
    const others = [...fingers.entries()].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    if (others.length) {
      const spread = place => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
      this.view.zoom(spread(now) / Math.max(1, spread(before)), ...this.at(event));
    } else if (!this.view.isWhole) {
      this.view.pan((before[0] - now[0]) * scale, (before[1] - now[1]) * scale);
    }
    fingers.set(event.pointerId, now);
  }
}

function pointsOf(course) { return course.map(([x, y]) => `${x.toFixed(3)},${(-y).toFixed(3)}`).join(" "); }

// A point of the way from one to another.
function between([[x, y], [z, w]], share) { return [x + share * (z - x), y + share * (w - y)]; }

// For each line whether it is the second, fourth ... between its substations.
function parallels(lines) {
  const count = {};
  return lines.map(([one, other]) => {
    const pair = [one, other].sort((a, b) => a - b).join();
    count[pair] = (count[pair] ?? 0) + 1;
    return count[pair] % 2 === 0;
  });
}

// Where a line, substation, generator, load or storage unit is drawn.
function placeOf(grid, { kind, number }) {
  if (kind === "substation") return grid.centres[number];
  if (kind === "line") return between(grid.middles[number], 0.5);
  const symbol = grid.symbols.find(each => each.kind === kind && each.number === number);
  return [symbol.x, symbol.y];
}

// Everything that can be searched for: kind, number and name.
function thingsOf(grid) {
  return [
    ...grid.subNames.map((name, number) => ({ kind: "substation", number, name })),
    ...grid.lineNames.map((name, number) => ({ kind: "line", number, name })),
    ...grid.symbols.map(({ kind, number, name }) => ({ kind, number, name })),
  ];
}

// The thing that words mean: "line 3", "load_3_2", a number alone (a substation's); null: nothing, or not yet one thing.
function findThing(grid, words) {
  const wanted = words.trim().toLowerCase().replace(/\s*\(.*\)$/, "");
  if (!wanted) return null;
  const things = thingsOf(grid), is = test => things.find(test);
  const exact = is(each => `${each.kind} ${each.number}` === wanted || each.name.toLowerCase() === wanted);
  if (exact) return exact;
  if (/^\d+$/.test(wanted)) return is(each => each.kind === "substation" && each.number === +wanted) ?? null;
  const beginning = things.filter(each => each.name.toLowerCase().startsWith(wanted));
  return beginning.length === 1 ? beginning[0] : null;
}

if (typeof document === "undefined") module.exports = { View, findThing, outline, placeOf, thingsOf };

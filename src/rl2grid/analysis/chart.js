"use strict";
// Draws every figure of the class "chart" from the numbers in it. Pointer: values; drag or Ctrl+wheel: zoom.
(() => {
  const DASHES = ["", "7 3", "1.6 3"], COLOURS = 6, LONGEST = 12;
  const MARGIN = { top: 10, right: 12, bottom: 34, left: 46 };

  const SPACE = new DOMParser().parseFromString("<svg></svg>", "text/html").body.firstChild.namespaceURI;

  function svg(name, attributes, parent) {
    const made = document.createElementNS(SPACE, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (parent) parent.append(made);
    return made;
  }

  function element(name, properties, parent) {
    const made = Object.assign(document.createElement(name), properties);
    if (parent) parent.append(made);
    return made;
  }

  const colour = (line) => `var(--curve-${line.look % COLOURS})`;
  const dashes = (line) => DASHES[Math.floor(line.look / COLOURS) % DASHES.length];

  function short(value) {
    const size = Math.abs(value), digits = (number) => String(+number.toPrecision(4));
    if (size >= 1e6) return `${digits(value / 1e6)}M`;
    if (size >= 1e4) return `${digits(value / 1e3)}k`;
    return size >= 1e3 ? Math.round(value).toLocaleString("en") : digits(value);
  }

  const percent = (value) => `${+(100 * value).toFixed(1)}%`;

  function ticks(low, high, number) {
    const rough = (high - low) / number, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 2.5, 5, 10].find((each) => each * power >= rough * 0.999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
    return found;
  }

  // The last point at or before x.
  function before(xs, x) {
    let low = 0, high = xs.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (xs[middle] <= x) low = middle; else high = middle - 1;
    }
    return low;
  }

  function valueAt(line, name, x, steps) {
    const xs = line.x, ys = line[name];
    if (!ys || x < xs[0] || x > xs[xs.length - 1]) return null;
    const k = before(xs, x);
    if (steps || k === xs.length - 1 || ys[k] === null || ys[k + 1] === null) return ys[k];
    return ys[k] + (ys[k + 1] - ys[k]) * (x - xs[k]) / (xs[k + 1] - xs[k]);
  }

  function pathOf(xs, ys, scale, steps) {
    let path = "", pen = "M", last = null;
    for (let k = 0; k < xs.length; k += 1) {
      if (ys[k] === null) { pen = "M"; continue; }
      const x = scale.x(xs[k]).toFixed(1), y = scale.y(ys[k]).toFixed(1);
      path += steps && pen === "L" ? `H${x}V${y}` : `${pen}${x} ${y}`;
      pen = "L";
      last = y;
    }
    return last === null ? "" : path;
  }

  function bandOf(line, scale, steps) {
    if (!line.low) return "";
    const up = pathOf(line.x, line.high, scale, steps);
    const xs = [], ys = [];
    for (let k = line.x.length - 1; k >= 0; k -= 1) {
      if (steps && k < line.x.length - 1) { xs.push(line.x[k + 1]); ys.push(line.low[k]); }
      xs.push(line.x[k]);
      ys.push(line.low[k]);
    }
    const down = pathOf(xs, ys, scale, false);
    return up && down ? `${up}${down.replace("M", "L")}Z` : "";
  }

  function extent(panel) {
    const xs = panel.lines.flatMap((line) => [line.x[0], line.x[line.x.length - 1]]);
    const right = Math.max(...xs, 1e-9);
    if (panel.share) return { x: [0, right], y: [0, 1.03] };
    let low = Infinity, high = -Infinity;
    for (const line of panel.lines) {
      for (const ys of [line.y, line.low || [], line.high || []]) {
        for (const y of ys) if (y !== null) { low = Math.min(low, y); high = Math.max(high, y); }
      }
    }
    if (panel.threshold !== null) { low = Math.min(low, 0); high = Math.max(high, panel.threshold); }
    if (!Number.isFinite(low)) { low = 0; high = 1; }
    const room = 0.05 * (high - low || 1);
    return { x: [0, right], y: [low - (low === 0 ? 0 : room), high + room] };
  }

  class Panel {
    constructor(chart, data, parent) {
      this.chart = chart;
      this.data = data;
      this.whole = extent(data);
      this.view = structuredClone(this.whole);
      const box = element("div", { className: "panel" }, parent);
      element("h4", { textContent: data.title }, box);
      this.svg = svg("svg", { class: "axes", tabindex: 0, role: "img", "aria-label": `${data.title}, by ${chart.data.x}` }, box);
      this.readout = element("div", { className: "readout", hidden: true }, box);
      this.readout.setAttribute("aria-live", "polite");
      this.listen();
      // Where a page is folded, there is no width before it is unfolded.
      new ResizeObserver(() => this.draw()).observe(box);
    }

    get zoomed() { return JSON.stringify(this.view) !== JSON.stringify(this.whole); }

    draw() {
      const width = this.svg.clientWidth;
      if (!width) return;
      const height = Math.round(Math.min(340, Math.max(210, 0.46 * width)));
      const inner = { x: [MARGIN.left, width - MARGIN.right], y: [height - MARGIN.bottom, MARGIN.top] };
      const { x: xs, y: ys } = this.view;
      const along = (from, to) => (value) => to[0] + (value - from[0]) / (from[1] - from[0]) * (to[1] - to[0]);
      this.scale = { x: along(xs, inner.x), y: along(ys, inner.y), backX: along(inner.x, xs), backY: along(inner.y, ys) };
      this.inner = inner;
      this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      this.svg.style.height = `${height}px`;
      this.svg.replaceChildren();
      this.drawAxes(width, height);
      const clip = `clip-${this.chart.number}-${this.chart.panels.indexOf(this)}`;
      svg("rect", { x: inner.x[0], y: inner.y[1] - 2, width: inner.x[1] - inner.x[0] + 6, height: inner.y[0] - inner.y[1] + 4 },
        svg("clipPath", { id: clip }, svg("defs", {}, this.svg)));
      const curves = svg("g", { "clip-path": `url(#${clip})` }, this.svg);
      for (const line of this.data.lines) if (this.chart.shown.has(line.label)) this.drawLine(line, curves);
      this.over = svg("g", {}, this.svg);
    }

    drawAxes(width, height) {
      const { inner, scale, view, data } = this, { x: xName, xShare } = this.chart.data;
      for (const tick of ticks(...view.y, 5)) {
        if (data.share && tick > 1.0001) continue;
        svg("line", { class: "rule", x1: inner.x[0], x2: inner.x[1], y1: scale.y(tick), y2: scale.y(tick) }, this.svg);
        svg("text", { x: inner.x[0] - 6, y: scale.y(tick) + 4, "text-anchor": "end" }, this.svg).textContent =
          data.share ? percent(tick) : short(tick);
      }
      const count = Math.max(2, Math.floor((inner.x[1] - inner.x[0]) / 75));
      for (const tick of ticks(...view.x, count)) {
        svg("line", { class: "rule", x1: scale.x(tick), x2: scale.x(tick), y1: inner.y[0], y2: inner.y[0] + 4 }, this.svg);
        // The last number would leave the paper if it were in the middle.
        const anchor = scale.x(tick) > inner.x[1] - 16 ? "end" : "middle";
        svg("text", { x: scale.x(tick) + (anchor === "end" ? 8 : 0), y: inner.y[0] + 16, "text-anchor": anchor }, this.svg).textContent =
          xShare ? percent(tick) : short(tick);
      }
      svg("text", { x: (inner.x[0] + inner.x[1]) / 2, y: height - 4, "text-anchor": "middle" }, this.svg).textContent = xName;
      if (data.threshold !== null) {
        const y = scale.y(data.threshold);
        if (y >= inner.y[1] && y <= inner.y[0]) {
          svg("line", { class: "threshold", x1: inner.x[0], x2: inner.x[1], y1: y, y2: y }, this.svg);
        }
      }
    }

    drawLine(line, parent) {
      const { scale } = this, { steps } = this.chart.data;
      const faint = this.chart.pointed !== null && this.chart.pointed !== line.label;
      const group = svg("g", { class: faint ? "faint" : "" }, parent);
      const opacity = Math.min(0.2, 0.7 / this.chart.shown.size);
      svg("path", { class: "band", d: bandOf(line, scale, steps), style: `fill:${colour(line)};fill-opacity:${opacity}` }, group);
      for (let k = 0; line.dots && k < line.dots.x.length; k += 1) {
        if (line.dots.y[k] === null) continue;
        svg("circle", { cx: scale.x(line.dots.x[k]), cy: scale.y(line.dots.y[k]), r: 1.4, style: `fill:${colour(line)};opacity:.35` }, group);
      }
      const style = `stroke:${colour(line)};stroke-dasharray:${dashes(line) || "none"}`;
      svg("path", { class: "curve", d: pathOf(line.x, line.y, scale, steps), style }, group);
      for (let k = 0; line.marks && k < line.marks.x.length; k += 1) {
        const x = scale.x(line.marks.x[k]), y = scale.y(line.marks.y[k]);
        svg("path", { d: `M${x} ${y - 4.5}l4.5 4.5-4.5 4.5-4.5-4.5z`, style: `fill:${colour(line)};stroke:var(--paper)` }, group);
      }
    }

    // Values of all curves at a place, the highest first.
    read(x) {
      const { steps, xShare } = this.chart.data;
      const rows = [];
      for (const line of this.data.lines) {
        if (!this.chart.shown.has(line.label)) continue;
        const value = valueAt(line, "y", x, steps);
        if (value === null) continue;
        rows.push({ line, value, low: valueAt(line, "low", x, steps), high: valueAt(line, "high", x, steps) });
      }
      rows.sort((a, b) => b.value - a.value);
      return { rows, place: `${this.chart.data.x}: ${xShare ? percent(x) : short(x)}` };
    }

    point(px) {
      const { inner, scale } = this;
      if (!scale) return;
      const x = scale.backX(Math.min(inner.x[1], Math.max(inner.x[0], px)));
      this.at = x;
      const { rows, place } = this.read(x), write = this.data.share ? percent : short;
      this.over.replaceChildren();
      svg("line", { class: "cross", x1: scale.x(x), x2: scale.x(x), y1: inner.y[0], y2: inner.y[1] }, this.over);
      const table = element("table", {});
      for (const { line, value, low, high } of rows.slice(0, LONGEST)) {
        const y = scale.y(value);
        if (y >= inner.y[1] - 2 && y <= inner.y[0] + 2) {
          svg("circle", { cx: scale.x(x), cy: y, r: 4, style: `fill:${colour(line)};stroke:var(--paper)` }, this.over);
        }
        const row = table.insertRow();
        row.insertCell().append(swatch(line, 14));
        row.insertCell().textContent = line.label;
        row.insertCell().append(element("b", { textContent: write(value) }));
        row.insertCell().append(element("small", { textContent: low === null ? "" : `[${write(low)}, ${write(high)}]` }));
      }
      const more = rows.length - LONGEST;
      this.readout.replaceChildren(element("div", { textContent: place }), table);
      if (more > 0) element("div", { textContent: `and ${more} lower` }, this.readout);
      this.readout.hidden = false;
      const right = scale.x(x) < (inner.x[0] + inner.x[1]) / 2;
      this.readout.style.left = right ? `${scale.x(x) + 14}px` : "auto";
      this.readout.style.right = right ? "auto" : `${this.svg.clientWidth - scale.x(x) + 14}px`;
    }

    leave() {
      this.at = null;
      this.over?.replaceChildren();
      this.readout.hidden = true;
    }

    look(view) {
      const inside = ([low, high], [first, last]) => {
        const width = Math.min(high - low, last - first), start = Math.min(Math.max(low, first), last - width);
        return [start, start + width];
      };
      const narrowest = (this.whole.x[1] - this.whole.x[0]) / 2000;
      if (view.x[1] - view.x[0] < narrowest) return;
      this.view = { x: inside(view.x, this.whole.x), y: inside(view.y, this.whole.y) };
      this.draw();
      this.chart.tools();
    }

    // Closer for a factor below 1, about a place from 0 to 1.
    zoom(factor, about = 0.5) {
      const [low, high] = this.view.x, centre = low + about * (high - low);
      this.look({ x: [centre - (centre - low) * factor, centre + (high - centre) * factor], y: this.view.y });
    }

    pan(by) {
      const [low, high] = this.view.x, way = by * (high - low);
      this.look({ x: [low + way, high + way], y: this.view.y });
    }

    reset() {
      this.view = structuredClone(this.whole);
      this.draw();
      this.chart.tools();
    }

    listen() {
      const place = (event) => {
        const box = this.svg.getBoundingClientRect();
        return [event.clientX - box.left, event.clientY - box.top];
      };
      let from = null;
      this.svg.addEventListener("pointerdown", (event) => {
        if (event.pointerType !== "mouse" || event.button !== 0) { this.point(place(event)[0]); return; }
        from = place(event);
        this.svg.setPointerCapture(event.pointerId);
      });
      this.svg.addEventListener("pointermove", (event) => {
        const [px, py] = place(event);
        this.point(px);
        if (from === null || !this.over) return;
        const box = this.dragged(from, [px, py]);
        if (box) svg("rect", { class: "chosen", x: box.x[0], y: box.y[0], width: box.x[1] - box.x[0], height: box.y[1] - box.y[0] }, this.over);
      });
      this.svg.addEventListener("pointerup", (event) => {
        if (from === null) return;
        const box = this.dragged(from, place(event));
        from = null;
        if (box) this.look({ x: box.x.map(this.scale.backX), y: [box.y[1], box.y[0]].map(this.scale.backY) });
      });
      this.svg.addEventListener("pointercancel", () => { from = null; });
      this.svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") this.leave(); });
      this.svg.addEventListener("dblclick", () => this.reset());
      this.svg.addEventListener("wheel", (event) => {
        // The wheel alone scrolls the page.
        if (!event.ctrlKey && !event.metaKey) return;
        event.preventDefault();
        this.zoom(event.deltaY > 0 ? 1.25 : 0.8, (place(event)[0] - this.inner.x[0]) / (this.inner.x[1] - this.inner.x[0]));
      }, { passive: false });
      this.svg.addEventListener("keydown", (event) => this.press(event));
      this.svg.addEventListener("blur", () => this.leave());
    }

    // What a drag chose; one that is flat chooses no heights, one that is short is a click.
    dragged(from, to) {
      const { inner } = this, within = (value, [a, b]) => Math.min(Math.max(a, b), Math.max(Math.min(a, b), value));
      const x = [from[0], to[0]].map((value) => within(value, inner.x)).sort((a, b) => a - b);
      const y = [from[1], to[1]].map((value) => within(value, inner.y)).sort((a, b) => a - b);
      if (x[1] - x[0] < 8) return null;
      return { x, y: y[1] - y[0] < 24 ? [inner.y[1], inner.y[0]] : y };
    }

    press(event) {
      const { inner, scale } = this;
      const middle = (inner.x[0] + inner.x[1]) / 2, px = this.at === null || this.at === undefined ? middle : scale.x(this.at);
      const acts = {
        ArrowLeft: () => (event.shiftKey ? this.pan(-0.2) : this.point(px - 8)),
        ArrowRight: () => (event.shiftKey ? this.pan(0.2) : this.point(px + 8)),
        "+": () => this.zoom(0.7), "-": () => this.zoom(1.4), 0: () => this.reset(), Escape: () => this.leave(),
      };
      if (!acts[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      acts[event.key]();
    }
  }

  function swatch(line, width) {
    const made = svg("svg", { width, height: 10, viewBox: `0 0 ${width} 10`, "aria-hidden": true });
    svg("path", { d: `M0 5H${width}`, style: `stroke:${colour(line)};stroke-width:3;stroke-dasharray:${dashes(line) || "none"}` }, made);
    return made;
  }

  class Chart {
    constructor(figure, number) {
      this.number = number;
      this.data = JSON.parse(figure.querySelector("script").textContent);
      this.pointed = null;
      this.shown = new Set(this.data.first);
      const caption = figure.querySelector("figcaption");
      const place = (className) => caption.parentNode.insertBefore(element("div", { className }), caption);
      const panels = place("panels");
      this.panels = [];
      for (const panel of this.data.panels) this.panels.push(new Panel(this, panel, panels));
      this.bar = place("tools");
      this.keys = place("keys");
      this.makeTools();
      this.makeKeys();
      this.tools();
    }

    get lines() { return [...new Map(this.data.panels.flatMap((panel) => panel.lines).map((line) => [line.label, line])).values()]; }

    redraw() {
      for (const panel of this.panels) {
        panel.leave();
        panel.draw();
      }
      for (const key of this.keys.children) key.setAttribute("aria-pressed", this.shown.has(key.dataset.label));
    }

    makeTools() {
      const button = (textContent, title, act) =>
        element("button", { type: "button", textContent, title, onclick: act }, this.bar);
      button("+", "Closer", () => this.panels.forEach((panel) => panel.zoom(0.6)));
      this.closer = [
        button("\u2212", "Farther", () => this.panels.forEach((panel) => panel.zoom(1 / 0.6))),
        button("\u25c2", "Left", () => this.panels.forEach((panel) => panel.pan(-0.3))),
        button("\u25b8", "Right", () => this.panels.forEach((panel) => panel.pan(0.3))),
        button("Whole", "Everything, as at first", () => this.panels.forEach((panel) => panel.reset())),
      ];
      const all = this.lines.map((line) => line.label);
      if (all.length > 1) {
        const show = (labels) => () => { this.shown = new Set(labels); this.redraw(); };
        button("All", "Every curve", show(all));
        button("None", "No curve", show([]));
        if (this.data.first.length < all.length) button(`Best ${this.data.first.length}`, "Those shown at first", show(this.data.first));
      }
      if (all.length > LONGEST) {
        const search = element("input", { type: "search", placeholder: `${all.length} methods`, ariaLabel: "Search methods" }, this.bar);
        search.addEventListener("input", () => {
          const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
          for (const key of this.keys.children) {
            key.hidden = !words.every((word) => key.dataset.label.toLowerCase().includes(word));
            key.style.display = key.hidden ? "none" : "";
          }
        });
      }
      element("span", { className: "note", textContent: "drag: zoom \u00b7 double click: whole \u00b7 name twice: alone" }, this.bar);
    }

    makeKeys() {
      const lines = this.lines;
      for (const line of lines) {
        const key = element("button", { type: "button", title: "Click: on or off. Double click: alone." }, this.keys);
        key.dataset.label = line.label;
        key.append(swatch(line, 18), line.label);
        key.setAttribute("aria-pressed", this.shown.has(line.label));
        key.addEventListener("click", () => {
          if (!this.shown.delete(line.label)) this.shown.add(line.label);
          this.redraw();
        });
        key.addEventListener("dblclick", () => { this.shown = new Set([line.label]); this.redraw(); });
        const stress = (label) => { this.pointed = label; this.panels.forEach((panel) => panel.draw()); };
        key.addEventListener("pointerenter", (event) => {
          if (event.pointerType === "mouse" && this.shown.has(line.label)) stress(line.label);
        });
        key.addEventListener("pointerleave", () => { if (this.pointed !== null) stress(null); });
      }
      this.keys.hidden = lines.length < 2;
      this.keys.style.display = lines.length < 2 ? "none" : "";
    }

    tools() {
      const zoomed = this.panels.some((panel) => panel.zoomed);
      for (const button of this.closer || []) button.hidden = !zoomed;
    }
  }

  document.querySelectorAll("figure.chart").forEach((figure, number) => new Chart(figure, number));
})();

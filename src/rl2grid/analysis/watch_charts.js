"use strict";
// The episode over time: worst loading of each agent, production and demand, weather. What never changes is drawn once.

const KIND_COLOURS = { nuclear: "#cc79a7", thermal: "#d55e00", hydro: "#0072b2", wind: "#56b4e9", solar: "#e69f00" };
const OTHER_COLOUR = "#999999";

// For each of `width` columns of pixels, the first step and the step after the last.
function columnsOf(width, steps) {
  return Array.from({ length: width }, (_, x) => {
    const from = Math.min(steps - 1, Math.floor(x / width * steps));
    return [from, Math.max(from + 1, Math.floor((x + 1) / width * steps))];
  });
}

class Chart {
  // `steps` is the length of the axis of time, `seek(step)` goes there, `tell(step)` says what is there, and
  // `paint(pen, width, height)` draws what never changes.
  constructor(canvas, steps, seek, tell, paint) {
    Object.assign(this, { canvas, steps, paint });
    const stepAt = event => {
      const box = canvas.getBoundingClientRect();
      return Math.round(Math.max(0, Math.min(1, (event.clientX - box.left) / box.width)) * (steps - 1));
    };
    canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); seek(stepAt(event)); });
    canvas.addEventListener("pointermove", event => {
      canvas.title = tell(stepAt(event));
      if (event.buttons) seek(stepAt(event));
    });
  }

  // Draws everything again: sizes, colours or what is shown have changed.
  repaint() {
    const { canvas } = this, ratio = devicePixelRatio || 1;
    this.width = canvas.clientWidth;
    this.height = canvas.clientHeight;
    if (!this.width) return;
    canvas.width = Math.round(this.width * ratio);
    canvas.height = Math.round(this.height * ratio);
    this.still = document.createElement("canvas");
    this.still.width = canvas.width;
    this.still.height = canvas.height;
    const pen = this.still.getContext("2d");
    pen.scale(ratio, ratio);
    this.paint(pen, this.width, this.height);
    if (this.step !== undefined) this.mark(this.step);
  }

  mark(step) {
    this.step = step;
    if (!this.still) return;
    const pen = this.canvas.getContext("2d"), ratio = this.canvas.width / this.width;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.drawImage(this.still, 0, 0);
    pen.scale(ratio, ratio);
    pen.fillStyle = inkOf(this.canvas);
    pen.fillRect(Math.min(this.width - 2, step / Math.max(1, this.steps - 1) * this.width - 1), 0, 2, this.height);
  }
}

function inkOf(node) { return getComputedStyle(node).color; }

// Worst loading as coloured bars; above them ticks where the agent acted, below those where protections or attacks did.
function paintLoading(episode, colours, selected, axis) {
  return (pen, width, height) => {
    episode.peaks ??= Array.from({ length: episode.steps }, (_, k) => episode.loadingAt(episode.worstAt(k), k));
    const top = 150, y = percent => height - Math.min(percent, top) / top * (height - 7);
    columnsOf(width, axis).forEach(([from, to], x) => {
      if (from >= episode.steps) return;
      let peak = 0;
      for (let k = from; k < Math.min(to, episode.steps); k++) peak = Math.max(peak, episode.peaks[k]);
      pen.fillStyle = colours[Math.min(peak, colours.length - 1)];
      pen.fillRect(x, y(peak), 1, height - y(peak));
    });
    const ink = inkOf(document.body);
    pen.fillStyle = ink;
    pen.fillRect(0, y(100), width, 1);
    for (const [step, kind] of episode.log()) {
      const place = step / Math.max(1, axis - 1) * width;
      if (kind === "agent") { pen.fillStyle = ink; pen.fillRect(place - 0.75, 0, 1.5, 6); }
      if (kind === "attack") { pen.fillStyle = "#cc79a7"; pen.fillRect(place - 1, height - 7, 2, 7); }
      if (kind === "trip" || kind === "end") { pen.fillStyle = "#d55e00"; pen.fillRect(place - 1, 0, 2, height); }
    }
    if (selected?.kind === "line") paintCurve(pen, width, axis, episode.steps, k => y(episode.loadingAt(selected.number, k)), ink, []);
  };
}

// Production by kind, one on top of the other, and demand as a line, as far as the episode `longest` knows it.
function paintMix(episode, longest, axis) {
  return (pen, width, height) => {
    const { kinds } = episode.totals, top = 1.05 * highest(longest);
    columnsOf(width, axis).forEach(([from], x) => {
      if (from >= episode.steps) return;
      let base = height;
      for (const kind of kinds) {
        const tall = episode.total(kind, from) / top * height;
        pen.fillStyle = KIND_COLOURS[kind] ?? OTHER_COLOUR;
        pen.fillRect(x, base - tall, 1, tall);
        base -= tall;
      }
    });
    paintCurve(pen, width, axis, longest.steps, k => height - longest.total("demand", k) / top * height, inkOf(document.body), []);
  };
}

function highest(episode) {
  let most = 1;
  for (let k = 0; k < episode.steps; k++) {
    const produced = episode.totals.kinds.reduce((sum, kind) => sum + episode.total(kind, k), 0);
    most = Math.max(most, produced, episode.total("demand", k));
  }
  return most;
}

// What wind and sun allow, as shares of what their generators can produce; dotted: what is produced where it is less.
function paintWeather(episode, longest, axis) {
  return (pen, width, height) => {
    pen.fillStyle = getComputedStyle(document.body).getPropertyValue("--rule");
    pen.fillRect(0, height - 1, width, 1);
    episode.totals.weather.forEach((kind, number) => {
      const y = (of, name) => k => height - 1 - Math.min(1, of.total(name, k) / of.totals.capacity[number]) * (height - 3);
      paintCurve(pen, width, axis, longest.steps, y(longest, `${kind} available`), KIND_COLOURS[kind], []);
      paintCurve(pen, width, axis, episode.steps, y(episode, kind), KIND_COLOURS[kind], [2, 3]);
    });
  };
}

function paintCurve(pen, width, axis, steps, y, colour, dash) {
  pen.strokeStyle = colour;
  pen.lineWidth = 1.5;
  pen.setLineDash(dash);
  pen.beginPath();
  columnsOf(width, axis).forEach(([from], x) => { if (from < steps) pen.lineTo(x, y(from)); });
  pen.stroke();
  pen.setLineDash([]);
}

if (typeof document === "undefined") module.exports = { columnsOf };

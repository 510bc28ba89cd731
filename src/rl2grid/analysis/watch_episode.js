"use strict";
// Decodes an episode and says what the grid looks like at a moment: a step, and in a cascade one of its rounds. No page.

function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return bytes;
}

// The inverse of what packs a series: compressed differences from step to step, column after column.
async function unpacked(text, steps) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const differences = new Uint8Array(await new Response(stream).arrayBuffer());
  const columns = differences.length / steps, rows = new Uint8Array(differences.length);
  for (let column = 0; column < columns; column++) {
    let value = 0;
    for (let step = 0; step < steps; step++) {
      value = (value + differences[column * steps + step]) & 255;
      rows[step * columns + column] = value;
    }
  }
  return rows;
}

async function loadEpisodes(data) {
  const series = ["rho", "power", "forward"], totals = ["high", "low"];
  for (const each of data.episodes) {
    for (const name of series) each[name] = await unpacked(each[name], each.steps);
    for (const name of totals) each.totals[name] = await unpacked(each.totals[name], each.steps);
  }
  return data.episodes.map(each => new Episode(each, data));
}

class Episode {
  constructor(own, common) {
    Object.assign(this, own);
    this.grid = common.grid;
    this.largest = common.largest;
    this.words = common.words;
    this.began = common.began;
    this.length = common.length;
    this.nLine = this.grid.lines.length;
    this.nSymbol = this.grid.symbols.length;
    this.columns = [...own.totals.kinds, ...own.totals.weather.map(kind => `${kind} available`), "demand"];
    this.cascadeAt = new Map(own.cascades.map(cascade => [cascade.step, cascade.rounds]));
    this.isLost = this.cascadeAt.has(this.steps);
    this.last = this.isLost ? this.steps : this.steps - 1;
    this.replayed = -1;
    this.seek(0);
  }

  // Rounds of a step: without a cascade, one.
  rounds(step) { return this.cascadeAt.get(step)?.length ?? 1; }

  // Shows a step as it ended, or one round of its cascade. Beyond the end of the episode, its end.
  seek(step, round = Infinity) {
    this.step = Math.max(0, Math.min(step, this.last));
    const rounds = this.cascadeAt.get(this.step);
    this.round = Math.min(round, this.rounds(this.step) - 1);
    const isSettled = this.round === this.rounds(this.step) - 1 && this.step < this.steps;
    this.inRound = rounds && !isSettled ? rounds[this.round] : null;
    this.replay(this.inRound ? this.step - 1 : this.step);
    if (!this.inRound) return;
    const moved = this.inRound.moved;
    this.topology = [...this.topology];
    for (let k = 0; k < moved.length; k += 2) this.topology[moved[k]] = moved[k + 1];
  }

  // The topology of a step: forwards from where we are, backwards from the beginning.
  replay(step) {
    if (this.replayed < 0 || step < this.replayed) {
      this.current = this.grid.elementSub.map(() => 1);
      this.next = 0;
    }
    let changed = this.replayed < 0 || step < this.replayed;
    for (; this.next < this.changes.length && this.changes[this.next][0] <= step; this.next++) {
      const moved = this.changes[this.next][1];
      for (let k = 0; k < moved.length; k += 2) this.current[moved[k]] = moved[k + 1];
      changed = true;
    }
    if (changed) this.settled = [...this.current];
    this.topology = this.settled;
    this.replayed = step;
  }

  // Whether there is a power flow to show.
  get hasFlow() { return this.inRound ? this.inRound.rho !== null : true; }

  // The row of what is known step by step; in the step of a game over, that before.
  get row() { return Math.min(this.step, this.steps - 1); }

  loading(line) {
    if (!this.inRound) return this.loadingAt(line, this.row);
    return this.inRound.rho ? this.inRound.rho[line] : 0;
  }

  loadingAt(line, step) { return this.rho[step * this.nLine + line]; }

  worst() {
    let best = 0;
    for (let line = 1; line < this.nLine; line++) if (this.loading(line) > this.loading(best)) best = line;
    return best;
  }

  worstAt(step) {
    let best = 0;
    for (let line = 1; line < this.nLine; line++) if (this.loadingAt(line, step) > this.loadingAt(best, step)) best = line;
    return best;
  }

  runsForward(line) { return (this.inRound ? this.inRound.forward[line] : this.forward[this.row * this.nLine + line]) === 1; }

  share(symbol) { return this.power[this.row * this.nSymbol + symbol] / 255; }

  megawatts(symbol) { return this.largest * this.share(symbol) ** 2; }

  total(name, step = this.row) {
    const column = this.columns.indexOf(name), k = step * this.columns.length + column;
    return this.totals.unit * (256 * this.totals.high[k] + this.totals.low[k]);
  }

  within(intervals, line) { return intervals.some(([l, from, to]) => l === line && from <= this.step && this.step < to); }

  isOn(line) { const [, , origin, extremity] = this.grid.lines[line]; return this.topology[origin] > 0 && this.topology[extremity] > 0; }

  // Why a line is out.
  outage(line) {
    const lost = this.step === this.steps;
    if (lost ? this.lostAttacked.includes(line) : this.within(this.attacked, line)) return "attacked";
    if (this.maintained.some(([l, from, to]) => l === line && from <= this.row && this.row < to)) return "maintenance";
    return "out";
  }

  // Elements that the end of the episode left without a grid, in its last frame.
  cutOff() { return this.step === this.steps && this.round === this.rounds(this.step) - 1 ? this.lost : []; }

  // What was switched in this step: lines opened or closed, substations with elements that changed their busbar.
  switched() {
    const moved = this.changes.find(([step]) => step === this.step)?.[1] ?? [];
    if (this.inRound || this.step === 0) return { lines: [], subs: [] };
    const ends = new Map(this.grid.lines.flatMap(([, , origin, extremity], line) => [[origin, line], [extremity, line]]));
    const before = this.topologyBefore(), lines = new Set(), subs = new Set();
    for (let k = 0; k < moved.length; k += 2) {
      const [element, busbar] = [moved[k], moved[k + 1]], isSwitch = busbar < 0 || before[element] < 0;
      if (ends.has(element) && isSwitch) lines.add(ends.get(element));
      else subs.add(this.grid.elementSub[element]);
    }
    return { lines: [...lines], subs: [...subs] };
  }

  topologyBefore() {
    const topology = this.grid.elementSub.map(() => 1);
    for (const [step, moved] of this.changes) {
      if (step >= this.step) break;
      for (let k = 0; k < moved.length; k += 2) topology[moved[k]] = moved[k + 1];
    }
    return topology;
  }

  // Lines whose loading changes most from a step to the next: [line, before, after].
  changedMost(step, count) {
    const all = this.grid.lines.map((_, line) => [line, this.loadingAt(line, step), this.loadingAt(line, step + 1)]);
    const most = all.filter(([, before, after]) => Math.max(before, after) >= 50 && before !== after);
    return most.sort((a, b) => Math.abs(b[2] - b[1]) - Math.abs(a[2] - a[1])).slice(0, count);
  }

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

  time(step) {
    const when = new Date(Date.parse(this.began + "Z") + step * 300000);
    return when.toLocaleString("en-GB", { timeZone: "UTC", weekday: "short", day: "2-digit", month: "short", hour: "2-digit", minute: "2-digit" });
  }

  lineName(line) { return `line ${line} (${this.grid.lineNames[line]})`; }

  // The last decision before a step of which the reason is known; -1: none.
  reasonBefore(step) {
    let found = -1;
    for (let k = 0; k < this.reasons.length && this.reasons[k].step < step; k++) found = k;
    return found;
  }

  // Everything that happened, in order: [step, kind, words].
  log() {
    if (this.story) return this.story;
    const story = [];
    for (const [step, words] of this.decisions) story.push([step + 1, "agent", this.words[words]]);
    for (const [step, words] of this.heuristic) story.push([step, "heuristic", this.words[words]]);
    for (const [line, from] of this.attacked) story.push([from, "attack", `${this.lineName(line)} is attacked`]);
    for (const [line, from] of this.maintained) story.push([from, "maintenance", `maintenance of ${this.lineName(line)}`]);
    for (const { step, rounds } of this.cascades) {
      for (const { trips } of rounds) for (const trip of trips) story.push([step, "trip", this.tripInWords(trip)]);
    }
    story.push([this.last, this.isLost ? "end" : "agent end", this.ending]);
    const order = ["maintenance", "attack", "agent", "heuristic", "trip", "end", "agent end"];
    story.sort((a, b) => a[0] - b[0] || order.indexOf(a[1]) - order.indexOf(b[1]));
    return this.story = story;
  }

  tripInWords([line, percent, overloaded]) {
    const cause = overloaded ? `overloaded for ${overloaded} steps` : "above the hard limit";
    return `protections open ${this.lineName(line)} at ${percent}%: ${cause}`;
  }
}

if (typeof document === "undefined") module.exports = { Episode, loadEpisodes, unpacked };

"use strict";
(() => {
  const PAGE = 50;
  const find = (id) => document.getElementById(id);
  const data = JSON.parse(find("rows").textContent);
  const columns = new Map(data.columns.map((column) => [column.name, column]));
  const table = find("explorer");
  const chosen = ["task", "method", "ended"];
  const comparisons = {
    "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b,
  };
  let sorted = null, descending = false, first = 0, rows = [];

  for (const column of data.columns) {
    column.value = column.words ? (row) => column.words[column.places[row]] : (row) => column.numbers[row];
    if (column.words) column.lower = column.words.map((word) => word.toLowerCase());
  }

  // Everything below works on numbers of rows, never on elements: a page of the table has few of those.
  function matcher(term) {
    const [, name, sign, value] = /^(\w+)(<=|>=|<|>|=)(.+)$/.exec(term) || [];
    const column = columns.get(name), compare = comparisons[sign], limit = Number(value);
    if (column && column.numbers && !Number.isNaN(limit)) return (row) => compare(column.numbers[row], limit);
    if (column && column.words && sign === "=") return (row) => column.lower[column.places[row]] === value;
    const hits = data.columns.filter((each) => each.words).map((each) => {
      const found = each.lower.map((word) => word.includes(term));
      return (row) => found[each.places[row]];
    });
    return (row) => hits.some((hit) => hit(row));
  }

  function filters() {
    const terms = find("search").value.toLowerCase().split(/\s+/).filter(Boolean).map(matcher);
    for (const name of chosen) {
      const column = columns.get(name), word = find(name).value;
      if (word === "") continue;
      const place = column.words.indexOf(word);
      terms.push((row) => column.places[row] === place);
    }
    return terms;
  }

  function order() {
    if (sorted === null) return;
    const column = columns.get(sorted), sign = descending ? -1 : 1;
    const collator = new Intl.Collator("en", { numeric: true });
    const compare = column.words
      ? (a, b) => collator.compare(column.value(a), column.value(b))
      : (a, b) => column.numbers[a] - column.numbers[b];
    rows.sort((a, b) => sign * compare(a, b) || a - b);
  }

  function select() {
    const terms = filters();
    rows = [];
    for (let row = 0; row < data.rows; row += 1) {
      if (terms.every((matches) => matches(row))) rows.push(row);
    }
    order();
    first = 0;
    show();
  }

  function text(column, row) {
    const value = column.value(row);
    if (column.words || Number.isInteger(value)) return column.words ? value : value.toLocaleString("en");
    return Math.abs(value) >= 1000 ? Math.round(value).toLocaleString("en") : String(Number(value.toPrecision(4)));
  }

  function cell(column, row) {
    const element = document.createElement("td");
    if (column.words) element.className = "words";
    if (column.name === "made") {
      const link = document.createElement("a");
      link.href = `#${column.value(row)}`;
      link.textContent = column.value(row);
      element.append(link);
      return element;
    }
    element.textContent = text(column, row);
    element.title = String(column.value(row));
    return element;
  }

  function show() {
    const visible = rows.slice(first, first + PAGE);
    const body = document.createElement("tbody");
    for (const row of visible) {
      const line = document.createElement("tr");
      line.append(...data.columns.map((column) => cell(column, row)));
      body.append(line);
    }
    table.replaceChild(body, table.tBodies[0]);
    for (const heading of table.tHead.rows[0].cells) {
      heading.removeAttribute("aria-sort");
      if (heading.dataset.name === sorted) heading.setAttribute("aria-sort", descending ? "descending" : "ascending");
    }
    const count = (number) => number.toLocaleString("en");
    const survival = columns.get("survival").numbers;
    const mean = rows.reduce((sum, row) => sum + survival[row], 0) / rows.length;
    find("shown").textContent = `${count(rows.length)} of ${count(data.rows)} episodes`
      + (rows.length ? `, mean survival ${mean.toFixed(3)}` : "");
    find("page").textContent = rows.length ? `${count(first + 1)} to ${count(first + visible.length)}` : "none";
    find("previous").disabled = first === 0;
    find("next").disabled = first + PAGE >= rows.length;
  }

  function turn(by) {
    first += by * PAGE;
    show();
  }

  function sortBy(name) {
    // The first click shows what is longest or latest of numbers last: episodes that were lost come first.
    descending = sorted === name && !descending;
    sorted = name;
    order();
    first = 0;
    show();
  }

  const heading = table.createTHead().insertRow();
  for (const column of data.columns) {
    const element = document.createElement("th"), button = document.createElement("button");
    element.dataset.name = column.name;
    if (column.words) element.className = "words";
    button.textContent = column.heading;
    button.addEventListener("click", () => sortBy(column.name));
    element.append(button);
    heading.append(element);
  }
  for (const name of chosen) {
    const choice = find(name);
    choice.append(new Option("all", ""), ...columns.get(name).words.map((word) => new Option(word, word)));
    choice.addEventListener("change", select);
  }
  find("search").addEventListener("input", select);
  find("previous").addEventListener("click", () => turn(-1));
  find("next").addEventListener("click", () => turn(1));
  select();
})();

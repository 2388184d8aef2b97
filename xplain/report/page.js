"use strict";
// Plots, filters and the player of a sweep's page. All it shows is in the page: nothing is fetched.
const D = JSON.parse(document.getElementById("plots").textContent);
const NS = "http://www.w3.org/2000/svg", SIGNS = "●■▲◆▼✚✖★", DASHES = ["", "6 3", "2 3", "8 3 2 3"];
const hidden = D.keys.map(() => new Set());
const make = (tag, text, cls) => {
  const e = document.createElement(tag);
  if (text !== undefined) e.textContent = text;
  if (cls) e.className = cls;
  return e;
};
const shape = (tag, attributes, text) => {
  const e = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(attributes)) e.setAttribute(name, value);
  if (text !== undefined) e.textContent = text;
  return e;
};
const first = D.x ? 1 : 0, lineKeys = D.keys.slice(first, first + D.lines), lastLine = first + D.lines;
const named = (at, from, to) => at.slice(from, to).map((v, i) => D.keys[from + i].labels[v]).filter(w => w !== "–").join(", ");
const distinct = (from, to) => [...new Map(D.cells.map(c => [c.at.slice(from, to).join(), c.at])).entries()]
  .sort((a, b) => { const p = a[1].slice(from, to), q = b[1].slice(from, to); for (let i = 0; i < p.length; i++) if (p[i] !== q[i]) return p[i] - q[i]; return 0; });
const lines = distinct(first, lastLine), panels = distinct(lastLine, D.keys.length);
const colour = i => `var(--c${i % 8})`;
const seen = cell => cell.at.every((v, i) => !hidden[i].has(v));

// A square root shows large and small ones together; a negative value keeps its sign.
const bend = y => D.roots ? Math.sign(y) * Math.sqrt(Math.abs(y)) : y;

function ticks(low, high) {
  const step = 10 ** Math.floor(Math.log10((high - low) / 3 || 1));
  const by = [1, 2, 5, 10].map(f => f * step).find(s => (high - low) / s <= 5) || step * 10;
  const found = [];
  for (let t = Math.ceil(low / by - 1e-9) * by; t <= high + 1e-9 * by; t += by) found.push(+t.toPrecision(10));
  return found;
}

function frame(title, low, high, map, xTicks, xTitle, yTitle) {
  const svg = shape("svg", { viewBox: "0 0 330 236", role: "img", "aria-label": `${yTitle} ${title}` });
  if (title) svg.append(shape("text", { x: 44, y: 13, class: "name" }, title));
  const y = v => 196 - 172 * (map(v) - map(low)) / ((map(high) - map(low)) || 1);
  for (const t of ticks(low, high)) {
    svg.append(shape("line", { x1: 44, x2: 326, y1: y(t), y2: y(t), stroke: "var(--line)", "stroke-width": t === 0 ? 1.6 : 0.7 }));
    svg.append(shape("text", { x: 38, y: y(t) + 4, "text-anchor": "end" }, String(t).replace("-", "−")));
  }
  for (const [x, word] of xTicks) svg.append(shape("text", { x, y: 212, "text-anchor": "middle" }, word));
  svg.append(shape("text", { x: 185, y: 230, "text-anchor": "middle" }, xTitle));
  return [svg, y];
}

function range(cells, name) {
  const all = cells.flatMap(c => (c.of[name] || []).filter(v => v !== null)).concat(0);
  const means = cells.map(c => c.of[name]?.[0]).filter(v => v !== undefined).concat(0);
  const span = Math.max(...means) - Math.min(...means) || 1;  // intervals of a few traces do not press all means together
  return [Math.max(Math.min(...all), Math.min(...means) - 1.2 * span), Math.min(Math.max(...all), Math.max(...means) + 1.2 * span)];
}

function plot(box, measure) {
  const cells = D.cells.filter(seen), grid = make("div", undefined, "panels");
  const shown = D.x ? D.keys[0].values.map((_, i) => i).filter(i => !hidden[0].has(i)) : [0];
  const numbers = D.x && D.keys[0].numbers;
  const known = numbers ? shown.map(i => numbers[i]).filter(v => v !== "") : [];
  const place = i => numbers ? 62 + 246 * (numbers[i] - Math.min(...known)) / ((Math.max(...known) - Math.min(...known)) || 1)
    : 44 + 282 * (shown.indexOf(i) + 0.5) / shown.length;
  const xTicks = D.x ? shown.filter(i => !numbers || numbers[i] !== "").map(i => [place(i), D.keys[0].values[i]]) : [];
  const gap = 282 / Math.max(shown.length, 2), both = range(cells, measure.name);
  let cut = false;
  for (const [id, at] of panels) {
    const own = cells.filter(c => c.at.slice(lastLine).join() === id);
    if (!own.length) continue;
    const [low, high] = D.alike ? both : range(own, measure.name);
    const [svg, y] = frame(named(at, lastLine, D.keys.length), low, high, bend, xTicks.length > 9 ? xTicks.filter((_, i) => i % Math.ceil(xTicks.length / 8) === 0) : xTicks, D.x ? D.keys[0].axis : "", measure.title);
    lines.forEach(([line], j) => {
      const points = own.filter(c => c.at.slice(first, lastLine).join() === line && c.of[measure.name]).sort((a, b) => a.at[0] - b.at[0]);
      if (!points.length) return;
      const shift = lines.length > 1 ? Math.min(7, gap / lines.length / 1.6) * (j - (lines.length - 1) / 2) : 0;
      const x = c => (D.x ? place(c.at[0]) : 185) + shift;
      if (numbers && points.length > 1) svg.append(shape("polyline", { points: points.map(c => `${x(c)},${y(c.of[measure.name][0])}`).join(" "), fill: "none", stroke: colour(j), "stroke-width": 1.8, "stroke-dasharray": DASHES[j % 4] }));
      for (const c of points) {
        const [mean, from, to] = c.of[measure.name];
        if (from !== null) {
          const [a, b] = [Math.max(from, low), Math.min(to, high)];
          cut = cut || a > from || b < to;
          svg.append(shape("line", { x1: x(c), x2: x(c), y1: y(a), y2: y(b), stroke: colour(j), "stroke-width": 1.3, opacity: 0.75 }));
        }
        const dot = shape("text", { x: x(c), y: y(mean) + 4.4, "text-anchor": "middle", style: `fill: ${colour(j)}`, "font-size": 12 }, SIGNS[j % 8]);
        dot.append(shape("title", {}, `${named(c.at, 0, D.keys.length)}: ${mean.toFixed(2)}` + (from === null ? "" : ` (95 % ${from.toFixed(2)} … ${to.toFixed(2)})`)));
        svg.append(dot);
      }
    });
    grid.append(svg);
  }
  box.replaceChildren(grid, legend(cells));
  if (cut) box.append(make("p", "Some intervals go on beyond the plot: so few traces or seeds decide little.", "soft"));
}

function legend(cells) {
  const key = make("div", undefined, "key");
  if (!lineKeys.length) return key;
  lines.forEach(([line, at], j) => {
    if (!cells.some(c => c.at.slice(first, lastLine).join() === line)) return;
    const entry = make("span");
    entry.append(Object.assign(make("b", SIGNS[j % 8] + " "), { style: `color: ${colour(j)}` }), named(at, first, lastLine) || "–");
    key.append(entry);
  });
  return key;
}

function beliefs(box) {
  const at0 = D.x && !hidden[0].has(D.keys[0].middle) ? D.keys[0].middle : D.x ? D.keys[0].values.findIndex((_, i) => !hidden[0].has(i)) : 0;
  const cells = D.cells.filter(c => seen(c) && c.belief.length && (!D.x || c.at[0] === at0));
  const grid = make("div", undefined, "panels"), steps = Math.max(2, ...cells.map(c => c.belief.length)) - 1;
  for (const [id, at] of panels) {
    const own = cells.filter(c => c.at.slice(lastLine).join() === id);
    if (!own.length) continue;
    const x = k => 48 + 246 * k / steps;
    const [svg, y] = frame(named(at, lastLine, D.keys.length), 0, 1, v => v, ticks(0, steps).filter(Number.isInteger).map(t => [x(t), t]), "steps explained", "belief");
    lines.forEach(([line], j) => {
      const cell = own.find(c => c.at.slice(first, lastLine).join() === line);
      if (!cell) return;
      const last = cell.belief.length - 1;
      svg.append(shape("polyline", { points: cell.belief.map((v, k) => `${x(k)},${y(v)}`).join(" "), fill: "none", stroke: colour(j), "stroke-width": 1.8, "stroke-dasharray": DASHES[j % 4] }));
      if (cell.episodes[last] < cell.episodes[0]) svg.append(shape("text", { x: x(last) + 4, y: y(cell.belief[last]) + 4, "font-size": 10 }, `${cell.episodes[last]} of ${cell.episodes[0]}`));
    });
    grid.append(svg);
  }
  box.replaceChildren(grid, legend(cells));
  box.append(make("p", `Mean over the episodes that last so long (how many at the end)${D.x ? ", at " + D.keys[0].labels[at0] : ""}.`, "soft"));
}

const title = word => word[0].toUpperCase() + word.slice(1);
const boxes = D.measures.slice(1).map(measure => {
  const box = make("div"), section = make("section");
  section.append(make("h2", title(measure.title)), box);
  return [section, () => plot(box, measure)];
});
if (D.cells.some(c => c.belief.length)) {
  const box = make("div"), section = make("section");
  section.append(make("h2", "Belief in the true type"), box);
  boxes.push([section, () => beliefs(box)]);
}
document.getElementById("others").append(...boxes.map(([section]) => section));
document.getElementById("main-title").textContent = title(D.measures[0].title);

function show() {
  plot(document.getElementById("main-plot"), D.measures[0]);
  for (const [, draw] of boxes) draw();
  const table = document.querySelector("#answer-table table");
  if (!D.filters) return;
  for (const row of table.tBodies[0].rows) {
    const words = row.dataset.words.split("\u001f");
    row.classList.toggle("out", D.down.some((k, j) => hidden[k].has(D.keys[k].values.indexOf(words[j]))));
    words.forEach((word, j) => { if (j < D.down.length) row.cells[j].textContent = word; });
  }
  D.across.forEach((way, j) => {
    const out = way.some(([k, v]) => hidden[k].has(v)), column = D.down.length + D.before + j;
    for (const row of table.rows) row.cells[column].classList.toggle("out", out);
  });
}

D.keys.forEach((key, k) => {
  if (key.values.length < 2 || key.values.length > 16) return;
  const set = make("fieldset");
  set.append(make("legend", key.name));
  key.values.forEach((word, v) => {
    const choice = make("label", word), box = make("input");
    box.type = "checkbox";
    box.checked = true;
    box.onchange = () => {
      if (!box.checked && hidden[k].size === key.values.length - 1) { box.checked = true; return; }  // one stays
      box.checked ? hidden[k].delete(v) : hidden[k].add(v);
      show();
    };
    choice.prepend(box);
    set.append(choice);
  });
  document.getElementById("filters").append(set);
});
show();

async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), c => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
}

async function player() {
  const [jobs, page] = [await unpacked("all-episodes"), await unpacked("player")];
  const choices = ["job", "trace", "user of type"].map(word => {
    const label = make("label", word), select = make("select");
    label.append(select);
    document.getElementById("choose").append(label);
    return select;
  });
  const [job, trace, user] = choices;
  const fill = (select, words) => {
    const before = select.value;
    select.replaceChildren(...words.map(word => new Option(word, word)));
    if (words.map(String).includes(before)) select.value = before;
  };
  const play = () => {
    const { episodes, label, of, ...shared } = jobs[job.selectedIndex];
    const own = episodes.filter(e => String(e.trace) === trace.value);
    fill(user, own.map(e => e.user));
    const data = JSON.stringify({ ...shared, ...own.find(e => e.user === user.value) }).replaceAll("<", "\\u003c");
    document.querySelector("iframe").srcdoc = page.replace("/*DATA*/null", () => data);
  };
  const begin = () => {
    fill(trace, [...new Set(jobs[job.selectedIndex].episodes.map(e => e.trace))]);
    play();
  };
  fill(job, jobs.filter(j => j.episodes.length).map(j => j.label));
  if (!job.options.length) { document.getElementById("episodes").hidden = true; return; }
  job.onchange = begin;
  trace.onchange = user.onchange = play;
  begin();
}
player();

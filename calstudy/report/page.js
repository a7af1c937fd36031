"use strict";

// Numbers as a reader writes them: three digits, with an exponent where they are large or small.
function brief(value) {
  if (value === null || Number.isNaN(value)) return "none";
  const size = Math.abs(value);
  return size !== 0 && (size >= 1e4 || size < 1e-2) ? value.toExponential(2) : String(Number(value.toPrecision(3)));
}

function element(name, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (parent) parent.append(made);
  return made;
}

// Tables: a click on a heading sorts, numbers as numbers; the fields above a table filter its rows.
function sortKey(text) {
  const number = Number.parseFloat(text.replace("−", "-"));
  return Number.isNaN(number) ? text.toLowerCase() : number;
}

function sortBy(table, column) {
  const headings = [...table.tHead.rows[0].cells];
  const rising = headings[column].getAttribute("aria-sort") !== "ascending";
  headings.forEach((cell) => cell.removeAttribute("aria-sort"));
  headings[column].setAttribute("aria-sort", rising ? "ascending" : "descending");
  const rows = [...table.tBodies[0].rows].map((row) => [sortKey(row.cells[column].textContent), row]);
  const order = (a, b) => (typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1);
  rows.sort((a, b) => (rising ? 1 : -1) * order(a[0], b[0]));
  table.tBodies[0].append(...rows.map((pair) => pair[1]));
}

function makeTable(table) {
  [...table.tHead.rows[0].cells].forEach((cell, column) => {
    const button = document.createElement("button");
    button.textContent = cell.textContent;
    button.addEventListener("click", () => sortBy(table, column));
    cell.replaceChildren(button);
  });
  const filter = table.closest("section").querySelector(".filter");
  if (!filter) return;
  const [words, verdict, count] = [filter.querySelector("input"), filter.querySelector("select"), filter.querySelector("span")];
  const apply = () => {
    let shown = 0;
    for (const row of table.tBodies[0].rows) {
      const text = row.textContent.toLowerCase();
      const wanted = words.value.toLowerCase().split(/\s+/).every((word) => text.includes(word));
      const verdicts = [...row.cells].filter((cell) => cell.dataset.verdict !== undefined);
      const fits = !verdict || !verdict.value || verdicts.some((cell) => cell.textContent === verdict.value);
      row.hidden = !(wanted && fits);
      shown += row.hidden ? 0 : 1;
    }
    count.textContent = `${shown} of ${table.tBodies[0].rows.length}`;
  };
  words.addEventListener("input", apply);
  if (verdict) verdict.addEventListener("change", apply);
  apply();
}

// Pictures: a click shows one at its full size.
function makePicture(image) {
  image.addEventListener("click", () => {
    const dialog = document.createElement("dialog"), large = document.createElement("img");
    large.src = image.src;
    large.alt = image.alt;
    dialog.append(large);
    dialog.addEventListener("click", () => dialog.close());
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
  });
}

// A range of one axis, zoomed about a place by the wheel and reset by a double click.
class Range {
  constructor(low, high) { this.all = [low, high]; this.now = [low, high]; }
  zoom(place, factor) {
    const [low, high] = this.now.map((end) => place + (end - place) * factor);
    this.now = [Math.max(low, this.all[0]), Math.min(high, this.all[1])];
  }
  reset() { this.now = [...this.all]; }
  part(value) { return (value - this.now[0]) / (this.now[1] - this.now[0]); }
  at(part) { return this.now[0] + part * (this.now[1] - this.now[0]); }
}

function ticks(low, high, logarithmic) {
  const found = [];
  if (logarithmic) {
    const step = Math.max(1, Math.ceil((high - low) / 7));
    for (let power = Math.ceil(low); power <= high; power += step) found.push([power, `1e${power}`]);
    return found;
  }
  const raw = (high - low) / 6, unit = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * unit).find((size) => size >= raw);
  for (let index = Math.ceil(low / step); index * step <= high + 1e-9 * step; index += 1) {
    found.push([index * step, String(Number((index * step).toPrecision(6)))]);
  }
  return found;
}

const WIDTH = 720, HEIGHT = 360, LEFT = 62, RIGHT = 10, TOP = 10, BOTTOM = 42;

function interact(shape, ranges, draw, tell) {
  const place = (event) => {
    const box = shape.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * WIDTH, y = ((event.clientY - box.top) / box.height) * HEIGHT;
    return [(x - LEFT) / (WIDTH - LEFT - RIGHT), 1 - (y - TOP) / (HEIGHT - TOP - BOTTOM)];
  };
  shape.addEventListener("pointermove", (event) => {
    const [x, y] = place(event);
    if (x >= 0 && x <= 1 && y >= 0 && y <= 1) tell(ranges[0].at(x), ranges[1].at(y));
  });
  shape.addEventListener("wheel", (event) => {
    // The page scrolls as usual; with Ctrl or Shift the wheel zooms.
    if (!event.ctrlKey && !event.shiftKey) return;
    event.preventDefault();
    const [x, y] = place(event), turn = event.deltaY || event.deltaX;
    ranges[0].zoom(ranges[0].at(x), turn < 0 ? 0.8 : 1.25);
    ranges[1].zoom(ranges[1].at(y), turn < 0 ? 0.8 : 1.25);
    draw();
  }, { passive: false });
  let start = null;
  shape.addEventListener("pointerdown", (event) => { start = place(event); });
  shape.addEventListener("pointerup", (event) => {
    const end = place(event);
    if (start && Math.abs(end[0] - start[0]) > 0.02) {
      const sides = [start[0], end[0]].map((part) => ranges[0].at(Math.min(Math.max(part, 0), 1))).sort((a, b) => a - b);
      ranges[0].now = sides;
      draw();
    }
    start = null;
  });
  shape.addEventListener("dblclick", () => { ranges.forEach((range) => range.reset()); draw(); });
}

function axes(svg, ranges, logarithmic, labels) {
  const at = (range, part, size) => part(range) * size;
  for (const [value, text] of ticks(...ranges[0].now, false)) {
    const x = LEFT + at(ranges[0], (range) => range.part(value), WIDTH - LEFT - RIGHT);
    element("line", { x1: x, x2: x, y1: TOP, y2: HEIGHT - BOTTOM, stroke: "var(--line)" }, svg);
    element("text", { x, y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }, svg).textContent = text;
  }
  for (const [value, text] of ticks(...ranges[1].now, logarithmic)) {
    const y = HEIGHT - BOTTOM - at(ranges[1], (range) => range.part(value), HEIGHT - TOP - BOTTOM);
    element("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y, y2: y, stroke: "var(--line)" }, svg);
    element("text", { x: LEFT - 6, y: y + 4, "text-anchor": "end" }, svg).textContent = text;
  }
  element("text", { x: (LEFT + WIDTH) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, svg).textContent = labels[0];
  const side = { x: -(HEIGHT - BOTTOM) / 2, y: 13, "text-anchor": "middle", transform: "rotate(-90)" };
  element("text", side, svg).textContent = labels[1];
}

function makeCurves(place, data) {
  const height = (y) => (data.logarithmic ? Math.log10(Math.abs(y)) : y);
  const finite = data.series.flatMap((one) => one.y).filter((y) => y !== null && Number.isFinite(height(y))).map(height);
  const xs = data.series.flatMap((one) => one.x);
  if (!finite.length) return;
  // Noise comes arbitrarily close to zero, of which a logarithm would show nothing else.
  const sorted = [...finite].sort((a, b) => a - b), low = sorted[data.logarithmic ? Math.floor(0.05 * sorted.length) : 0];
  const high = sorted[sorted.length - 1], margin = 0.04 * (high - low || 1);
  const ranges = [new Range(Math.min(...xs), Math.max(...xs)), new Range(low - margin, high + margin)];
  const svg = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" });
  const value = document.createElement("div");
  value.className = "value";
  const colour = (one) => `var(--${one.colour})`;
  const point = (x, y) => [LEFT + ranges[0].part(x) * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - ranges[1].part(height(y)) * (HEIGHT - TOP - BOTTOM)];
  const inside = ([x, y]) => x >= LEFT - 1 && x <= WIDTH - RIGHT + 1 && y >= TOP - 1 && y <= HEIGHT - BOTTOM + 1;
  const draw = () => {
    svg.replaceChildren();
    axes(svg, ranges, data.logarithmic, [data.x, data.logarithmic ? `|${data.y.split(" ")[0]}| ${data.y.split(" ").slice(1).join(" ")}` : data.y]);
    for (const one of data.series) {
      one.y.forEach((y, index) => {
        const [x, top] = point(one.x[index], y);
        if (!inside([x, top])) return;
        const error = one.error[index];
        if (error) {
          const ends = [y - error, y + error].map((end) => (data.logarithmic && end * y <= 0 ? HEIGHT - BOTTOM : point(one.x[index], end)[1]));
          const [low, high] = ends.map((end) => Math.min(Math.max(end, TOP), HEIGHT - BOTTOM));
          element("line", { x1: x, x2: x, y1: low, y2: high, stroke: colour(one), "stroke-width": 1, opacity: 0.6 }, svg);
        }
        const open = data.logarithmic && y < 0;
        element("circle", { cx: x, cy: top, r: 3, fill: open ? "var(--paper)" : colour(one), stroke: colour(one) }, svg);
      });
    }
  };
  const tell = (x) => {
    const parts = data.series.map((one) => {
      let best = 0;
      one.x.forEach((k, index) => { if (Math.abs(k - x) < Math.abs(one.x[best] - x)) best = index; });
      return [one, best];
    }).filter(([one, best]) => one.x.length && Math.abs(one.x[best] - x) <= (ranges[0].all[1] - ranges[0].all[0]) / 20);
    if (!parts.length) return;
    show(value, `${data.x.split(" ")[0]} = ${brief(parts[0][0].x[parts[0][1]])}`, parts.map(([one, best]) => [
      `${one.label}: ${brief(one.y[best])}${one.error[best] ? ` ± ${brief(one.error[best])}` : ""}`, colour(one)]));
  };
  interact(svg, ranges, draw, tell);
  place.append(svg, value);
  show(value, data.logarithmic ? "Open circles: negative." : "", data.series.map((one) => [one.label, colour(one)]));
  draw();
}

function show(value, text, parts) {
  const made = [[text, "inherit"], ...parts].filter((part) => part[0]).map(([words, colour]) => {
    const span = document.createElement("span");
    span.textContent = words;
    span.style.color = colour;
    return span;
  });
  value.replaceChildren(...made);
}

// Viridis at nine places.
const SHADES = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121], [109, 205, 89], [253, 231, 37]];

function shade(part) {
  const place = Math.min(Math.max(part, 0), 1) * (SHADES.length - 1), below = Math.min(Math.floor(place), SHADES.length - 2);
  return SHADES[below].map((low, index) => Math.round(low + (place - below) * (SHADES[below + 1][index] - low)));
}

function decode(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

function makeMaps(place, data) {
  const series = data.series.map((one) => ({ ...one, values: decode(one.values) }));
  const choice = document.createElement("select");
  series.forEach((one, index) => choice.add(new Option(one.label, index)));
  const scale = (y) => (data.logarithmic ? Math.log10(Math.abs(y)) : y);
  const all = series.flatMap((one) => Array.from(one.values, scale)).filter(Number.isFinite).sort((a, b) => a - b);
  if (!all.length) return;
  // Half a percent at either end would take most of the colours.
  const limits = data.logarithmic ? [0.005, 0.995].map((part) => all[Math.floor(part * (all.length - 1))]) : [0, 1.2];
  const first = series[0], columns = first.k_perp.length, rows = first.k_parallel.length;
  const ranges = [new Range(0, columns), new Range(0, first.k_parallel[rows - 1])];
  const canvas = document.createElement("canvas"), value = document.createElement("div");
  [canvas.width, canvas.height, value.className] = [WIDTH, HEIGHT, "value"];
  const row = (k) => Math.min(Math.max(Math.round((k / first.k_parallel[rows - 1]) * (rows - 1)), 0), rows - 1);
  const draw = () => {
    const one = series[choice.value], context = canvas.getContext("2d"), style = getComputedStyle(document.body);
    const [width, height] = [WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM];
    context.clearRect(0, 0, WIDTH, HEIGHT);
    for (let x = 0; x < width; x += 1) {
      const column = Math.min(Math.floor(ranges[0].at((x + 0.5) / width)), columns - 1);
      for (let y = 0; y < height; y += 2) {
        const index = row(ranges[1].at(1 - (y + 1) / height));
        const level = scale(one.values[column * rows + index]);
        context.fillStyle = Number.isFinite(level) ? `rgb(${shade((level - limits[0]) / (limits[1] - limits[0]))})` : "#888888";
        context.fillRect(LEFT + x, TOP + y, 1, 2);
      }
    }
    context.strokeStyle = "#ffffff";
    context.beginPath();
    one.horizon.forEach((part, column) => {
      const y = HEIGHT - BOTTOM - ranges[1].part(part * first.k_parallel[rows - 1]) * height;
      for (const side of [column, column + 1]) {
        const x = LEFT + ranges[0].part(side) * width;
        if (x >= LEFT && x <= WIDTH - RIGHT && y >= TOP) context.lineTo(x, y);
      }
    });
    context.stroke();
    [context.fillStyle, context.font, context.textAlign] = [style.color, "12px sans-serif", "end"];
    for (const [k, text] of ticks(...ranges[1].now, false)) context.fillText(text, LEFT - 6, HEIGHT - BOTTOM - ranges[1].part(k) * height + 4);
    context.textAlign = "center";
    for (const [column] of ticks(...ranges[0].now, false)) {
      const index = Math.round(column);
      if (index < columns) context.fillText(brief(one.k_perp[index]), LEFT + ranges[0].part(index + 0.5) * width, HEIGHT - BOTTOM + 16);
    }
    context.fillText("k_perp [h/Mpc], bins of baseline length", (LEFT + WIDTH) / 2, HEIGHT - 6);
    context.save();
    context.rotate(-Math.PI / 2);
    context.fillText("k_parallel [h/Mpc]", -(HEIGHT - BOTTOM) / 2, 13);
    context.restore();
  };
  const tell = (x, k) => {
    const one = series[choice.value], column = Math.min(Math.floor(x), columns - 1), index = row(k);
    show(value, `${data.value.split(" ")[0]} = ${brief(one.values[column * rows + index])}`, [
      [`k_perp = ${brief(one.k_perp[column])}`, "inherit"], [`k_parallel = ${brief(one.k_parallel[index])}`, "inherit"],
      [`baseline of ${brief(one.baseline_length[column])} m`, "inherit"]]);
  };
  interact(canvas, ranges, draw, tell);
  choice.addEventListener("change", draw);
  place.append(choice, canvas, value);
  show(value, `${data.value}: ${brief(data.logarithmic ? 10 ** limits[0] : limits[0])} (dark) to ${brief(data.logarithmic ? 10 ** limits[1] : limits[1])} (light), line: horizon`, []);
  draw();
}

document.querySelectorAll("section table").forEach(makeTable);
document.querySelectorAll("figure img").forEach(makePicture);
document.querySelectorAll(".chart").forEach((place) => {
  const data = JSON.parse(place.querySelector("script").textContent);
  (data.kind === "curves" ? makeCurves : makeMaps)(place, data);
});

// Pieces that the interactive parts of the report are made of. Text from the run only ever goes into text nodes
// and attributes, never into markup.

const SVG = "http://www.w3.org/2000/svg";

// What a script element of the page holds, or null.
function dataOf(id) {
  const element = document.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

// An HTML element: h("p", {class: "note"}, "text", other).
const h = (tag, attributes, ...children) => filled(document.createElement(tag), attributes, children);

// The same for SVG.
const s = (tag, attributes, ...children) => filled(document.createElementNS(SVG, tag), attributes, children);

const round = (value, digits = 2) => (Number.isInteger(value) ? String(value) : value.toFixed(digits));
const percent = (share) => `${(100 * share).toFixed(share > 0 && share < 0.1 ? 1 : 0)} %`;

// Radio buttons that look like one row of buttons; the keyboard works as everywhere.
function choice(legend, name, options, chosen, onChange) {
  const radios = options.map(([value, text]) =>
    h("label", {},
      h("input", { type: "radio", name, value, checked: value === chosen, onchange: () => onChange(value) }),
      h("span", {}, text)));
  return h("fieldset", { class: "choice" }, h("legend", {}, legend), radios);
}

function dropDown(label, options, chosen, onChange) {
  const select = h("select", { onchange: (event) => onChange(event.target.value) },
    options.map(([value, text]) => h("option", { value, selected: value === chosen }, text)));
  return h("label", { class: "drop-down" }, h("span", {}, label), select);
}

const panel = (title, ...content) => h("div", { class: "panel" }, h("h3", {}, title), content);

// A grid of cell kinds, `digits` x by x, with triangles {x, y, heading, kind} on it and cells marked {x, y}.
function grid(digits, size, kinds, label, triangles = [], marks = [], className = "") {
  const cells = [];
  for (let x = 0; x < size; x++) {
    for (let y = 0; y < size; y++) {
      const kind = Number(digits[x * size + y]);
      cells.push(s("rect", { x, y, width: 1, height: 1, class: `cell cell-${kind}` }));
      if (kinds[kind] === "goal") cells.push(s("path", { d: diamond(x + 0.5, y + 0.5, 0.28), class: "goal-mark" }));
      if (kinds[kind] === "unseen") {
        cells.push(s("path", { d: `M${x + 0.15} ${y + 0.85}L${x + 0.85} ${y + 0.15}`, class: "unseen-mark" }));
      }
    }
  }
  for (const [x, y, mark] of marks) {
    cells.push(s("rect", { x: x + 0.04, y: y + 0.04, width: 0.92, height: 0.92, class: mark }));
  }
  return s("svg", { viewBox: `-0.05 -0.05 ${size + 0.1} ${size + 0.1}`, role: "img", "aria-label": label,
    class: `grid ${className}` }, cells, triangles.map(triangle));
}

const diamond = (x, y, r) => `M${x} ${y - r}L${x + r} ${y}L${x} ${y + r}L${x - r} ${y}Z`;

// Heading 0 points right, 1 down, 2 left, 3 up.
function triangle({ x, y, heading, kind }) {
  return s("path", { d: "M0.36 0L-0.26 0.27L-0.12 0L-0.26 -0.27Z", class: kind,
    transform: `translate(${x + 0.5} ${y + 0.5}) rotate(${90 * heading})` });
}

// A belief: one row per factor, one column per value; an entry is a value where certain, else a distribution.
function beliefMap(rows, numValues, names, label) {
  const left = 3.4, cell = 2, height = 1.5;
  const parts = [];
  for (let k = 0; k < numValues; k++) {
    parts.push(s("text", { x: left + k * cell + cell / 2, y: 0.95, class: "axis", "text-anchor": "middle" }, String(k)));
  }
  const words = rows.map((row, i) => {
    const chances = distribution(row, numValues);
    const y = 1.3 + i * height;
    parts.push(s("text", { x: left - 0.4, y: y + 1.05, class: "axis", "text-anchor": "end" }, names[i]));
    chances.forEach((p, k) => {
      const x = left + k * cell;
      parts.push(s("rect", { x, y, width: cell - 0.08, height: height - 0.08, class: "heat-empty" }));
      if (p > 0) {
        parts.push(s("rect", { x, y, width: cell - 0.08, height: height - 0.08, class: "heat", "fill-opacity": p }));
      }
      if (p >= 0.995) parts.push(s("circle", { cx: x + cell / 2 - 0.04, cy: y + height / 2, r: 0.28, class: "sure" }));
    });
    const best = chances.indexOf(Math.max(...chances));
    return `${names[i]}: ${best} (${percent(chances[best])})`;
  });
  return s("svg", { viewBox: `0 0 ${left + numValues * cell} ${1.4 + rows.length * height}`, role: "img",
    "aria-label": `${label}. ${words.join(", ")}`, class: "belief-map" }, parts);
}

function distribution(row, numValues) {
  if (Array.isArray(row)) return row;
  return Array.from({ length: numValues }, (_, k) => (k === row ? 1 : 0));
}

// Values of actions as bars from zero; `rows` [[name, value, note]], the highest marked.
function bars(caption, rows, chosen) {
  const values = rows.map((row) => row[1]);
  const low = Math.min(0, ...values), high = Math.max(0, ...values), span = high - low || 1;
  return h("table", { class: "bars" }, h("caption", {}, caption), h("tbody", {}, rows.map(([name, value, note], i) =>
    h("tr", { class: i === chosen ? "chosen" : null },
      h("th", { scope: "row" }, i === chosen ? "▸ " : "", name, i === chosen ? h("span", { class: "hidden" }, " (chosen)") : null),
      h("td", { class: "bar" }, s("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true" },
        s("rect", { x: (100 * (Math.min(0, value) - low)) / span, y: 1, width: (100 * Math.abs(value)) / span,
          height: 8, class: value < 0 ? "negative" : "positive" }))),
      h("td", { class: "number" }, round(value)),
      note === undefined ? null : h("td", { class: "number" }, note)))));
}

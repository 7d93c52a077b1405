// The graph of the 2DBN: an action and a factor are chosen, its parents, table, meanings and rules are shown.

function graphView(root, data) {
  const n = data.factors.length;
  const state = { action: data.actions.length > 2 ? 2 : 0, factor: 0 };
  const picture = h("div", { class: "panel graph-picture" });
  const details = h("div", { class: "panel graph-details" });
  const said = h("p", { class: "hidden", "aria-live": "polite" });
  root.replaceChildren(
    choice("Action", "graph-action", data.actions.map((name, a) => [String(a), name]), String(state.action),
      (value) => { state.action = Number(value); draw(); }),
    h("div", { class: "columns" }, picture, details), said);

  const nodeName = ([where, factor]) => data.factors[factor] + (where ? "′" : "");

  function select(factor, focus) {
    state.factor = (factor + n) % n;
    draw();
    if (focus) picture.querySelector('[aria-pressed="true"]').focus();
  }

  function draw() {
    picture.replaceChildren(drawing());
    details.replaceChildren(...description());
    said.textContent = details.querySelector("h3").textContent;
  }

  function drawing() {
    const left = 40, right = 230, step = 46, top = 46, radius = 16;
    const y = (i) => top + i * step;
    const arcs = [], nodes = [];
    data.factors.forEach((name, child) => {
      for (const [where, parent, strength] of data.tables[state.action][child].parents) {
        const on = child === state.factor;
        const bend = 30 + 13 * Math.abs(parent - child);
        const d = where
          ? `M${right + radius} ${y(parent)}C${right + bend} ${y(parent)} ${right + bend} ${y(child)} ${right + radius + 5} ${y(child)}`
          : `M${left + radius} ${y(parent)}C${left + 90} ${y(parent)} ${right - 90} ${y(child)} ${right - radius - 5} ${y(child)}`;
        arcs.push([on, s("path", { d, class: `arc ${where ? "inside" : "across"} ${on ? "on" : ""}`,
          "stroke-width": 1 + 4 * strength, "marker-end": on ? `url(#tip-${where})` : null })]);
      }
    });
    arcs.sort((one, other) => one[0] - other[0]);
    data.factors.forEach((name, i) => {
      nodes.push(s("g", { class: "node now" }, s("circle", { cx: left, cy: y(i), r: radius }),
        s("text", { x: left, y: y(i) + 4, "text-anchor": "middle" }, name)));
      const chosen = i === state.factor;
      nodes.push(s("g", { class: `node next ${chosen ? "chosen" : ""}`, role: "button", "data-factor": i,
        tabindex: chosen ? 0 : -1, "aria-pressed": String(chosen), "aria-label": `Factor ${name}`,
        onclick: () => select(i, true), onkeydown: (event) => pressed(event, i) },
        s("circle", { cx: right, cy: y(i), r: radius + 2 }),
        s("text", { x: right, y: y(i) + 4, "text-anchor": "middle" }, `${name}′`)));
    });
    const tips = [0, 1].map((where) => s("marker", { id: `tip-${where}`, viewBox: "0 0 8 8", refX: 6, refY: 4,
      markerWidth: 8, markerHeight: 8, orient: "auto", markerUnits: "userSpaceOnUse",
      class: where ? "inside" : "across" }, s("path", { d: "M0 0L8 4L0 8Z" })));
    return s("svg", { viewBox: `0 0 360 ${top + n * step}`, class: "graph", role: "group",
      "aria-label": `Parents of every factor under '${data.actions[state.action]}'` },
      s("defs", {}, tips), s("text", { x: left, y: 16, "text-anchor": "middle", class: "axis" }, "now"),
      s("text", { x: right, y: 16, "text-anchor": "middle", class: "axis" }, "next"),
      arcs.map((arc) => arc[1]), nodes);
  }

  function pressed(event, i) {
    const moves = { ArrowDown: i + 1, ArrowRight: i + 1, ArrowUp: i - 1, ArrowLeft: i - 1, Home: 0, End: n - 1,
      Enter: i, " ": i };
    if (!(event.key in moves)) return;
    event.preventDefault();
    select(moves[event.key], true);
  }

  function description() {
    const name = data.factors[state.factor], action = data.actions[state.action];
    const table = data.tables[state.action][state.factor];
    return [
      h("h3", { id: "graph-chosen" }, `${name} after '${action}'`),
      h("p", {}, table.parents.length ? "Decided by " : "Depends on nothing.",
        table.parents.map((parent, i) => [i ? ", " : "", h("strong", {}, nodeName(parent)),
          ` (${round(parent[2])})`]).flat(), table.parents.length ? h("span", { class: "note" },
          " — in brackets how far the parent's value changes the distribution, from 0 to 1.") : null),
      lazy(`Table: ${table.rows.length} of ${table.num_rows.toLocaleString("en")} rows`, () => rowsOf(table), "graph-table"),
      lazy(`What the values of ${name} mean`, () => valuesOf(state.factor), "graph-values", true),
      lazy(`Rules that use ${name}`, () => rulesOf(state.factor), "graph-rules"),
    ];
  }

  // A part that is made when it is opened for the first time, and stays open from one factor to the next.
  const opened = new Set(["graph-values"]);
  function lazy(title, make, id) {
    const part = h("details", { id }, h("summary", {}, title));
    const fill = () => { if (part.children.length === 1) part.append(make()); };
    part.addEventListener("toggle", () => {
      if (part.open) { opened.add(id); fill(); } else opened.delete(id);
    });
    if (opened.has(id)) { part.open = true; fill(); }
    return part;
  }

  function rowsOf(table) {
    const share = table.visits ? table.visits_shown / table.visits : 0;
    return h("div", {},
      h("p", { class: "note" }, `The rows most often met in experience, ${percent(share)} of ` +
        `${table.visits.toLocaleString("en")} transitions. Left out: ` +
        `${Math.max(0, table.met - table.rows.length).toLocaleString("en")} rows met more rarely and ` +
        `${(table.num_rows - table.met).toLocaleString("en")} never met.`),
      h("div", { class: "scroll tall", tabindex: 0, role: "region", "aria-label": "Rows of the table" },
        h("table", {}, h("thead", {}, h("tr", {},
          table.parents.map((parent) => h("th", { scope: "col" }, nodeName(parent))),
          h("th", { scope: "col", class: "number" }, "met"), h("th", { scope: "col" }, "value: chance"))),
          h("tbody", {}, table.rows.map(([values, count, chances]) => h("tr", {},
            values.map((value) => h("td", {}, String(value))), h("td", { class: "number" }, count.toLocaleString("en")),
            h("td", {}, chances.map(([value, p]) => h("span", { class: "chance" }, `${value}: ${percent(p)}`)))))))));
  }

  function valuesOf(factor) {
    const size = Math.round(Math.sqrt(data.views.length ? data.views[0].length : 1));
    const visits = data.values[factor].reduce((sum, value) => sum + value.visits, 0) || 1;
    return h("ul", { class: "values" }, data.values[factor].map((value, k) => h("li", {},
      h("h4", {}, `${data.factors[factor]} = ${k}`), h("p", { class: "note" },
        value.views ? `${value.views} of ${data.total_views} distinct views, ${percent(value.visits / visits)} of the time`
          : "not met"),
      h("div", { class: "thumbnails" }, value.pictures.map((index, rank) => grid(data.views[index], size,
        data.cell_kinds, `View ${rank + 1} most often met with ${data.factors[factor]} = ${k}`))),
      value.holds.length ? h("p", {}, h("strong", {}, "always: "), value.holds.join(", ")) : null,
      value.fails.length ? h("p", {}, h("strong", {}, "never: "), value.fails.join(", ")) : null,
      value.leans.length ? h("p", {}, h("strong", {}, "more or less often: "), value.leans.map(([name, share, base]) =>
        `${name} ${percent(share)} (of all views ${percent(base)})`).join(", ")) : null)));
  }

  function rulesOf(factor) {
    if (!data.rules[factor].length) return h("p", {}, "No predicate depends on this factor by itself.");
    return h("div", {}, h("p", { class: "note" }, "Rules of the predicates that this factor tells most about."),
      data.rules[factor].map((entry) => h("div", {},
        h("h4", {}, entry.predicate), h("p", { class: "note" }, `${entry.meaning}; this factor alone tells ` +
          `${round(entry.information)} bits; on held-out views precision ${round(entry.precision)}, recall ` +
          `${round(entry.recall)}.`),
        h("ul", { class: "rules" }, entry.rules.map(([text, right, applies]) =>
          h("li", {}, h("code", {}, text), ` (right in ${right} of ${applies} views)`))),
        entry.left_out ? h("p", { class: "note" }, `${entry.left_out} further rules are left out.`) : null)));
  }

  draw();
}

// The replay viewer: an episode is chosen, a slider goes through its steps.

function replayView(root, data) {
  const state = { agent: "", outcome: "", order: "comparison", episode: 0, step: 0, timer: null };
  const nameOf = (e) => [e.agent, e.inputs === "full" ? "" : e.inputs, e.influence,
    data.episodes.some((other) => other.variant !== e.variant) ? e.variant : ""].filter(Boolean).join(" / ");
  const distinct = (values) => [...new Set(values)];
  const agents = distinct(data.episodes.map(nameOf)), outcomes = distinct(data.episodes.map((e) => e.outcome));
  const all = (names, text) => [["", text], ...names.map((name) => [name, name])];
  const chooser = h("div", { class: "drop-downs" });
  const slider = h("input", { type: "range", min: 0, value: 0, id: "replay-slider", "aria-label": "Step of the episode",
    oninput: (event) => { pause(); go(Number(event.target.value)); } });
  const button = (text, label, action) => h("button", { type: "button", "aria-label": label, onclick: action }, text);
  const play = button("Play", "Play", () => (state.timer ? pause() : start()));
  const status = h("p", { id: "replay-status", "aria-live": "polite", class: "status" });
  const scene = h("div", { class: "panels" });
  const transport = h("div", { class: "transport" }, h("div", { class: "controls" },
    button("|◀", "First step", () => { pause(); go(0); }), button("◀", "Step back", () => { pause(); go(state.step - 1); }),
    play, button("▶", "Step forward", () => { pause(); go(state.step + 1); }),
    button("▶|", "Last step", () => { pause(); go(Infinity); }), slider), status);
  root.replaceChildren(chooser, transport, scene);

  function listed() {
    const found = data.episodes.map((episode, index) => ({ episode, index })).filter(({ episode }) =>
      (!state.agent || nameOf(episode) === state.agent) && (!state.outcome || episode.outcome === state.outcome));
    if (state.order === "regret") {
      found.sort((one, other) => (other.episode.regret ?? -Infinity) - (one.episode.regret ?? -Infinity));
    }
    return found;
  }

  function refilter(changes) {
    Object.assign(state, changes);
    const found = listed();
    if (found.length && !found.some(({ index }) => index === state.episode)) state.episode = found[0].index;
    if (changes.order === "regret" && found.length) state.episode = found[0].index;
    const focused = [...chooser.querySelectorAll("select")].indexOf(document.activeElement);
    const title = ({ episode: e }) => `${nameOf(e)}, episode ${e.episode}: ${e.outcome}, return ${round(e.return, 1)}` +
      (e.regret === null ? "" : `, regret ${round(e.regret, 1)}`) + ` (${e.why.join(", ")})`;
    chooser.replaceChildren(
      dropDown("Agent", all(agents, "all agents"), state.agent, (agent) => refilter({ agent })),
      dropDown("Outcome", all(outcomes, "all outcomes"), state.outcome, (outcome) => refilter({ outcome })),
      dropDown("Order", [["comparison", "as compared"], ["regret", "worst regret first"]], state.order,
        (order) => refilter({ order })),
      dropDown(`Episode (${found.length})`, found.map((item) => [String(item.index), title(item)]), String(state.episode),
        (index) => { state.episode = Number(index); open(); }));
    if (focused >= 0) chooser.querySelectorAll("select")[focused].focus();
    if (found.length) open();
    else { pause(); status.textContent = "No episode fits."; scene.replaceChildren(); }
  }

  function open() {
    pause();
    slider.max = data.episodes[state.episode].steps.length - 1;
    go(0);
  }

  function start() {
    if (state.step >= Number(slider.max)) go(0);
    state.timer = setInterval(() => {
      go(state.step + 1);
      if (state.step >= Number(slider.max)) pause();
    }, 700);
    play.textContent = "Pause";
    play.setAttribute("aria-label", "Pause");
  }

  function pause() {
    clearInterval(state.timer);
    state.timer = null;
    play.textContent = "Play";
    play.setAttribute("aria-label", "Play");
  }

  function go(step) {
    const episode = data.episodes[state.episode], last = episode.steps.length - 1;
    state.step = Math.max(0, Math.min(step, last));
    slider.value = state.step;
    const now = episode.steps[state.step];
    const total = episode.steps.slice(0, state.step + 1).reduce((sum, item) => sum + item.reward, 0);
    const end = state.step === last ? ` The episode ends: ${episode.outcome}.` : "";
    const text = `Step ${state.step + 1} of ${last + 1}: ${data.action_names[now.action]}, reward ${round(now.reward)}, ` +
      `return so far ${round(total)}.${end}`;
    slider.setAttribute("aria-valuetext", text);
    status.textContent = text;
    scene.replaceChildren(...panels(episode, now).filter(Boolean));
  }

  function panels(episode, now) {
    const size = Math.round(Math.sqrt(now.view.length)), kinds = data.cell_kinds, k = data.num_values;
    const viewer = { x: Math.floor(size / 2), y: size - 1, heading: 3 };
    const picture = (digits, label, kind, others = [], marks = []) =>
      grid(digits, size, kinds, label, [{ ...viewer, kind }, ...others], marks);
    const seen = now.seen ? [{ x: now.seen[0], y: now.seen[1], heading: now.seen[2], kind: "person" }] : [];
    const where = now.seen ? "the person is in view" : "the person is not in view";
    return [
      panel("Map", mapOf(episode), legend(), h("p", { class: "note" }, `Decides: ${episode.algorithm}; model: ${episode.model}.`)),
      panel("What the robot sees", picture(now.view, `The robot's view; ${where}`, "robot", seen),
        h("p", { class: "note" }, `Upwards is ahead; ${where}.`)),
      now.belief ? panel("Belief b", beliefMap(now.belief, k, data.factor_names, "Belief b"),
        h("p", { class: "note" }, "Factors by values; a dot marks certainty.")) : null,
      now.shifted ? panel("Belief b~ of what the person sees", beliefMap(now.shifted, k, data.factor_names, "Belief b~"),
        h("p", { class: "note" }, now.decoded_shifted ? "What the agent takes the person to see." :
          "The agent knows nothing of what the person sees.")) : null,
      panel("What the person sees", personViews(now, size, picture)),
      now.q ? panel("Q values of the DQN", bars("Value of every action",
        now.q.map((value, a) => [data.action_names[a], value]), now.action)) : null,
      now.plan ? panel("What the planner weighed", planOf(now)) : null,
      now.plan ? panel("Where the planner takes the person to be", whereMap(now.plan.where)) : null,
      now.plan && now.plan.tree ? panel("Top of the search tree", treeOf(now.plan.tree)) : null,
      now.rules ? panel("Rules of the shield", rulesOf(now.rules)) : null,
    ];
  }

  function personViews(now, size, picture) {
    const wrong = [];
    if (now.decoded_shifted) {
      for (let i = 0; i < size * size; i++) {
        if (now.decoded_shifted[i] !== now.person_view[i]) wrong.push([Math.floor(i / size), i % size, "wrong"]);
      }
    }
    const agree = size * size - wrong.length;
    return h("div", {}, h("div", { class: "pair" },
      h("figure", {}, picture(now.person_view, "The person's true view", "person"), h("figcaption", {}, "in truth")),
      now.decoded_shifted ? h("figure", {}, picture(now.decoded_shifted, "The view that b~ stands for", "person", [], wrong),
        h("figcaption", {}, "as estimated")) : null),
      h("p", { class: "note" }, now.decoded_shifted ? `${agree} of ${size * size} cells agree` +
        (wrong.length ? "; the others are framed." : ".") : "No estimate at this moment."));
  }

  // The map with both agents, their trails, and the cells of the robot's view.
  function mapOf(episode) {
    const now = episode.steps[state.step], map = data.maps[now.map], size = map.size;
    const ahead = [[1, 0], [0, 1], [-1, 0], [0, -1]], reach = Math.round(Math.sqrt(now.view.length));
    const marks = [];
    const [ax, ay, heading] = now.agent, f = ahead[heading], r = ahead[(heading + 1) % 4];
    for (let far = 0; far < reach; far++) {
      for (let side = -Math.floor(reach / 2); side <= Math.floor(reach / 2); side++) {
        const x = ax + f[0] * far + r[0] * side, y = ay + f[1] * far + r[1] * side;
        if (x >= 0 && y >= 0 && x < size && y < size) marks.push([x, y, "in-view"]);
      }
    }
    const triangles = [{ x: ax, y: ay, heading, kind: "robot" }];
    if (now.person) triangles.unshift({ x: now.person[0], y: now.person[1], heading: now.person[2], kind: "person" });
    const places = `robot at ${ax}, ${ay}` + (now.person ? `, person at ${now.person[0]}, ${now.person[1]}` : "");
    const drawn = grid(map.cells, size, data.cell_kinds, `Map: ${places}`, triangles, marks, "map");
    for (const [who, kind] of [["agent", "robot-trail"], ["person", "person-trail"]]) {
      const points = episode.steps.slice(0, state.step + 1).filter((item) => item[who])
        .map((item) => `${item[who][0] + 0.5},${item[who][1] + 0.5}`);
      drawn.insertBefore(s("polyline", { points: points.join(" "), class: kind }), drawn.querySelector("path.robot"));
    }
    return drawn;
  }

  function legend() {
    const sample = (kind) => s("svg", { viewBox: "0 0 1 1", class: "sample", "aria-hidden": "true" },
      triangle({ x: 0, y: 0, heading: 0, kind }));
    const cell = (kind) => grid(String(data.cell_kinds.indexOf(kind)), 1, data.cell_kinds, kind, [], [], "sample");
    const entry = (picture, text) => h("span", {}, picture, text);
    return h("p", { class: "note legend" }, entry(sample("robot"), "robot"), entry(sample("person"), "person"),
      data.cell_kinds.map((kind) => entry(cell(kind), kind)), entry("", "framed: in the robot's view"));
  }

  function planOf(now) {
    const rows = now.plan.values.map((value, a) => [data.action_names[a], value, `${now.plan.visits[a]}×`]);
    return h("div", {}, bars(`Value, and how often tried in ${now.plan.simulations} simulations`, rows, now.action));
  }

  // Relative to the robot, which looks up.
  function whereMap(places) {
    const far = Math.max(2, ...places.map(([side, ahead]) => Math.max(Math.abs(side), Math.abs(ahead))));
    const width = 2 * far + 1, best = places.length ? places[0] : null;
    const parts = [];
    for (let x = 0; x < width; x++) {
      for (let y = 0; y < width; y++) parts.push(s("rect", { x, y, width: 0.95, height: 0.95, class: "heat-empty" }));
    }
    for (const [side, ahead, p] of places) {
      parts.push(s("rect", { x: far + side, y: far - ahead, width: 0.95, height: 0.95, class: "heat",
        "fill-opacity": Math.max(0.12, p) }));
    }
    const place = best && [best[0] ? `${Math.abs(best[0])} ${best[0] < 0 ? "left" : "right"}` : "",
      best[1] ? `${Math.abs(best[1])} ${best[1] < 0 ? "behind" : "ahead"}` : ""].filter(Boolean).join(", ");
    const words = best ? `most probable: ${place || "the same cell"} (${percent(best[2])})` : "nowhere";
    return h("div", {}, s("svg", { viewBox: `0 0 ${width} ${width}`, role: "img", class: "grid",
      "aria-label": `Place of the person relative to the robot, ${words}` }, parts,
      triangle({ x: far, y: far, heading: 3, kind: "robot" })), h("p", { class: "note" }, `Relative to the robot; ${words}.`));
  }

  function treeOf(node) {
    const list = (branch, depth) => h("ul", { class: "tree" }, [...branch.actions].sort((one, other) =>
      other.visits - one.visits).map((edge) => {
      const head = `${data.action_names[edge.action]}: ${round(edge.value)}, ${edge.visits} visits`;
      if (!edge.after || !edge.after.length) return h("li", {}, head);
      const rest = edge.left_out > 0 ? h("li", { class: "note" }, `${edge.left_out} rarer observations`) : null;
      return h("li", {}, h("details", { open: depth === 0 && edge.visits === Math.max(...branch.actions.map((a) => a.visits)) },
        h("summary", {}, head), h("ul", { class: "tree" }, edge.after.map((after) =>
          h("li", {}, `${after.seen} (${after.visits})`, list(after, depth + 1))), rest)));
    }));
    return list(node, 0);
  }

  function rulesOf(rules) {
    return h("div", {}, rules.conflict ? h("p", {}, "The rules forbid every action here; the fallback decides.") : null,
      h("ul", { class: "rules" }, data.action_names.map((name, a) => {
        const places = rules.because[name] || [];
        const word = rules.allowed[a] ? (rules.preferred[a] ? "preferred" : "allowed") : "forbidden";
        return h("li", {}, h("strong", {}, name), `: ${word}`, places.length ? h("span", { class: "note" },
          ` by ${places.join(", ")}`) : null);
      })));
  }

  // Begin with an episode that shows most: a planner's, with an estimated belief of the person.
  const telling = data.episodes.findIndex((e) => e.influence === "perspective-shift" && e.steps.some((item) => item.plan));
  refilter({ episode: Math.max(0, telling) });
}

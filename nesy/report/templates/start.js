// Fills the interactive parts of the page.

for (const [place, source, view] of [["graph-view", "graph-data", graphView], ["replay-view", "replay-data", replayView]]) {
  const root = document.getElementById(place), data = dataOf(source);
  if (root && data) view(root, data);
}

"""The report in a real browser: it loads, answers mouse and keyboard, fits a phone, and can be read by everybody."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nesy.report.sections import SECTIONS
from tests.browser.conftest import Opened

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def report(tiny_run: Path) -> Path:
    return tiny_run / "report.html"


@pytest.fixture
def opened(browser: Any, report: Path) -> Iterator[Opened]:
    page = Opened(browser, report, 1280, "light")
    yield page
    page.page.close()


def test_loads_without_complaints_or_network(opened: Opened, report: Path) -> None:
    assert opened.complaints == []
    assert [url for url in opened.requests if not url.startswith("data:")] == [report.as_uri()]
    assert report.stat().st_size < 10_000_000
    paint = opened.page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    assert paint > 0


def test_every_section_is_there_and_linked(opened: Opened) -> None:
    for section in SECTIONS:
        assert opened.page.locator(f"#{section.ANCHOR} h2").inner_text() == section.TITLE
        assert opened.page.locator(f"#{section.ANCHOR}").bounding_box()["height"] > 60
        assert opened.page.locator(f'nav a[href="#{section.ANCHOR}"]').count() == 1


def test_clicking_a_factor_shows_its_parents_table_meanings_and_rules(opened: Opened, tiny_run: Path) -> None:
    page = opened.page
    before = page.locator(".graph-details").inner_text()
    page.locator("[data-factor='5']").click()
    after = page.locator(".graph-details").inner_text()
    assert before != after
    assert page.locator("#graph-chosen").inner_text() == "X5 after 'forward'"
    model = json.loads((tiny_run / "dbn" / "model.json").read_text())
    parents = [f"X{p}" for p in model["parents_now"][2][5]] + [f"X{p}′" for p in model["parents_next"][2][5]]
    assert page.locator(".graph-details > p strong").all_inner_texts() == parents
    assert page.locator("#graph-table table").count() == 0  # made when it is opened
    page.locator("#graph-table summary").click()
    assert page.locator("#graph-table tbody tr").count() > 3
    assert page.locator("#graph-table th").all_inner_texts()[: len(parents)] == parents
    assert page.locator("#graph-values li").count() == 8
    assert page.locator("#graph-values svg").count() > 8
    page.locator("#graph-rules summary").click()
    assert "X5" in page.locator("#graph-rules code").first.inner_text()


def test_choosing_an_action_changes_the_parents(opened: Opened) -> None:
    page = opened.page
    page.locator("input[name=graph-action][value='0']").check()
    assert page.locator("#graph-chosen").inner_text() == "X0 after 'left'"
    arcs = page.locator(".arc.on").count()
    assert arcs == page.locator(".graph-details > p strong").count() > 0


def test_the_graph_answers_the_keyboard(opened: Opened) -> None:
    page = opened.page
    page.locator("[data-factor='0']").focus()
    for key, chosen in (("ArrowDown", 1), ("ArrowDown", 2), ("ArrowUp", 1), ("End", 7), ("Home", 0), ("ArrowUp", 7)):
        page.keyboard.press(key)
        assert page.locator("#graph-chosen").inner_text().startswith(f"X{chosen} ")
        assert page.evaluate("document.activeElement.dataset.factor") == str(chosen)


def test_scrubbing_a_replay_changes_what_is_shown(opened: Opened, tiny_run: Path) -> None:
    page, replays = opened.page, json.loads((tiny_run / "results" / "replays.json").read_text())
    assert page.locator("#replay-view option").count() > len(replays["episodes"])
    picture, status = page.locator("svg.map"), page.locator("#replay-status")
    first = (picture.inner_html(), status.inner_text())
    page.locator("#replay-slider").focus()
    page.keyboard.press("ArrowRight")
    second = (picture.inner_html(), status.inner_text())
    assert first[0] != second[0] and second[1].startswith("Step 2 of ")
    page.keyboard.press("End")
    assert "The episode ends: " in status.inner_text()
    page.keyboard.press("Home")
    assert (picture.inner_html(), status.inner_text()) == first
    page.get_by_label("Step forward").click()
    assert status.inner_text() == second[1]
    assert page.locator("svg.belief-map").count() == 2


def test_episodes_are_found_by_agent_outcome_and_regret(opened: Opened, tiny_run: Path) -> None:
    page, replays = opened.page, json.loads((tiny_run / "results" / "replays.json").read_text())
    episodes = replays["episodes"]
    chooser = page.locator("#replay-view .drop-downs select")
    chooser.nth(0).select_option("random")
    wanted = [e for e in episodes if e["agent"] == "random"]
    assert chooser.nth(3).locator("option").count() == len(wanted)
    chooser.nth(0).select_option("")
    outcome = episodes[0]["outcome"]
    chooser.nth(1).select_option(outcome)
    assert chooser.nth(3).locator("option").count() == sum(e["outcome"] == outcome for e in episodes)
    chooser.nth(1).select_option("")
    chooser.nth(2).select_option("regret")
    worst = max(e["regret"] for e in episodes if e["regret"] is not None)
    assert f"regret {worst:.1f}" in chooser.nth(3).locator("option").first.inner_text()


def test_values_of_dqn_and_planner_are_shown(opened: Opened) -> None:
    page = opened.page
    chooser = page.locator("#replay-view .drop-downs select")
    shown = {"dqn / random": "Q values of the DQN", "pomdp / perspective-shift": "What the planner weighed"}
    for agent, title in shown.items():
        chooser.nth(0).select_option(agent)
        assert page.locator(".panel h3", has_text=title).count() == 1
        assert page.locator("#replay-view .bars tr").count() == 4
        assert page.locator("#replay-view .bars tr.chosen").count() == 1
    assert page.locator("#replay-view ul.tree").count() >= 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_overflows_a_phone(browser: Any, report: Path, scheme: str) -> None:
    page = Opened(browser, report, 375, scheme).page
    page.locator("#graph-table summary").click()
    page.locator("#graph-rules summary").click()
    assert page.evaluate("document.documentElement.scrollWidth") == 375
    # a table may be wider, within a box that scrolls
    wide = page.evaluate(
        """[...document.querySelectorAll('main *')].filter((e) => e.getBoundingClientRect().right > 376
        && !e.closest('.scroll, .plot, pre, svg, .hidden')).map((e) => e.tagName + '.' + e.className)"""
    )
    assert wide == []
    small = page.evaluate(
        """[...document.querySelectorAll('button, select, .choice label')].map((e) => e.getBoundingClientRect())
        .filter((box) => box.height < 32 || box.width < 32).length"""
    )
    assert small == 0
    page.close()


CONTRASTS = """() => {
  const parse = (text) => {
    const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
    return [r, g, b, a];
  };
  const luminance = ([r, g, b]) => {
    const [x, y, z] = [r, g, b].map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * x + 0.7152 * y + 0.0722 * z;
  };
  const behind = (element) => {
    const node = element.closest && element.closest('.node');
    if (node) return parse(getComputedStyle(node.querySelector('circle')).fill);
    for (let e = element; e; e = e.parentElement) {
      const colour = parse(getComputedStyle(e).backgroundColor);
      if (colour[3] === 1) return colour;
    }
    return [255, 255, 255, 1];
  };
  const poor = [];
  let seen = 0;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.textContent.trim() || ['SCRIPT', 'STYLE', 'NOSCRIPT'].includes(element.tagName)) continue;
    if (!element.checkVisibility() || element.closest('.hidden, .plot, .skip')) continue;
    const style = getComputedStyle(element), inSvg = element instanceof SVGElement;
    const front = luminance(parse(inSvg ? style.fill : style.color)), back = luminance(behind(element));
    const ratio = (Math.max(front, back) + 0.05) / (Math.min(front, back) + 0.05);
    seen += 1;
    if (ratio < 4.5) poor.push([element.tagName, element.textContent.slice(0, 40), ratio]);
  }
  return [seen, poor];
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_what_is_behind_it(browser: Any, report: Path, scheme: str) -> None:
    page = Opened(browser, report, 1280, scheme).page
    page.locator("#graph-table summary").click()
    seen, poor = page.evaluate(CONTRASTS)
    assert seen > 200
    assert poor == []
    page.close()


def test_colours_of_cells_and_agents_stand_apart_for_everybody(browser: Any, report: Path) -> None:
    """Lightness alone, which no kind of colour blindness takes away, tells wall from empty and agents from floor."""
    luminance = """(name) => { const s = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
      const v = [1, 3, 5].map((i) => parseInt(s.slice(i, i + 2), 16) / 255)
        .map((c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
      return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]; }"""
    for scheme in ("light", "dark"):
        page = Opened(browser, report, 1280, scheme).page
        for one, other in (("--cell-0", "--cell-1"), ("--robot", "--cell-0"), ("--person", "--cell-0"),
                           ("--goal", "--cell-2"), ("--heat", "--heat-empty"), ("--sure", "--heat")):  # fmt: skip
            a, b = sorted((page.evaluate(luminance, one), page.evaluate(luminance, other)))
            assert (b + 0.05) / (a + 0.05) >= 3.0, (scheme, one, other)
        page.close()


def test_names_headings_and_focus_order(opened: Opened) -> None:
    page = opened.page
    assert page.evaluate("document.documentElement.lang") == "en"
    assert page.locator("h1").count() == 1
    levels = page.evaluate("[...document.querySelectorAll('h1, h2, h3, h4')].map((e) => Number(e.tagName[1]))")
    assert all(later <= earlier + 1 for earlier, later in itertools.pairwise(levels))
    unnamed = page.evaluate(
        """[...document.querySelectorAll('input, select, button, svg[role=img], [role=button], [role=group]')]
        .filter((e) => !(e.getAttribute('aria-label') || e.closest('label') || e.textContent.trim()))
        .map((e) => e.outerHTML.slice(0, 80))"""
    )
    assert unnamed == []
    assert page.locator("main table:not(:has(caption))").count() == page.locator("#graph-table table").count()
    identifiers = page.evaluate("[...document.querySelectorAll('main [id]:not(svg *)')].map((e) => e.id)")
    assert len(identifiers) == len(set(identifiers))
    order = []
    for _ in range(40):
        page.keyboard.press("Tab")
        order.append(page.evaluate("[...document.querySelectorAll('*')].indexOf(document.activeElement)"))
    reached = order[: next((i for i in range(1, len(order)) if order[i] <= order[i - 1]), len(order))]
    assert len(reached) > 20
    assert reached == sorted(reached)
    assert page.locator("[tabindex]:not([tabindex='0']):not([tabindex='-1'])").count() == 0


def test_text_of_a_run_cannot_inject_markup(browser: Any, run_copy: Path) -> None:
    """A folder from a stranger: names that look like markup are shown as they are."""
    from nesy.report.page import write_report
    from nesy.run_folder import RunFolder

    evil = "</script><script>window.hurt=1</script><img src=x onerror=window.hurt=1>"
    path = run_copy / "results" / "replays.json"
    replays = json.loads(path.read_text())
    replays["episodes"][0]["agent"] = evil
    replays["episodes"][0]["outcome"] = evil
    replays["action_names"] = [evil + str(i) for i in range(4)]
    path.write_text(json.dumps(replays))
    summary = json.loads((run_copy / "summary.json").read_text())
    summary["comparison"][0]["agent"] = evil
    summary["provenance"]["variant"] = evil
    (run_copy / "summary.json").write_text(json.dumps(summary))
    opened = Opened(browser, write_report(RunFolder(run_copy)), 1280, "light")
    assert opened.page.evaluate("window.hurt") is None
    assert opened.page.locator("main img").count() == 0
    assert evil in opened.page.locator("#replay-view").inner_text()
    assert not [text for text in opened.complaints if "Content Security" not in text]
    opened.page.close()

"""Write the pictures of README from a finished run: python scripts/readme_images.py --run runs/demo.

The picture of the replay viewer needs Playwright (extra `browser`) and a Chromium.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro

from nesy.errors import UserError
from nesy.report import examples, figures
from nesy.run_folder import RunFolder, atomic_path


@dataclass(frozen=True)
class Arguments:
    """Options of the script."""

    run: Path = Path("runs/demo")
    """The run folder."""
    to: Path = Path("docs/images")
    """Where the pictures go."""
    agent: str = "search / perspective-shift"
    """Whose episode the replay viewer shows, as it calls it."""
    step: int = 5
    """At which step."""


def main(options: Arguments) -> None:
    """Write belief.svg and replay.png."""
    belief(options)
    replay(options)


def belief(options: Arguments) -> None:
    """A belief, the shifted belief, and what they decode to."""
    example = examples.belief_example(RunFolder.open(options.run))
    if example is None:
        raise UserError(f"{options.run}: the person is never in view in the experience of this run")
    with atomic_path(options.to / "belief.svg") as temporary:
        temporary.write_text(figures.belief_panel(example), encoding="utf-8")


def replay(options: Arguments) -> None:
    """One moment of an episode in the report's replay viewer, in 128 colours."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        raise UserError("no Chromium here, which the picture of the replay viewer needs")
    with sync_playwright() as playwright, atomic_path(options.to / "replay.png") as temporary:
        opened = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-gpu"])
        page = opened.new_page(viewport={"width": 1280, "height": 900}, color_scheme="light")
        page.goto((options.run.resolve() / "report.html").as_uri())
        agents = page.locator("#replay-view .drop-downs select").first
        known = agents.locator("option").all_inner_texts()
        if options.agent not in known:
            raise UserError(f"--agent '{options.agent}' has no replay in this run; there are {', '.join(known)}")
        agents.select_option(options.agent)
        page.locator("#replay-slider").focus()
        for _ in range(options.step - 1):
            page.keyboard.press("ArrowRight")
        page.evaluate("document.activeElement.blur()")
        page.locator("#replay-view").screenshot(path=temporary, type="png")
        opened.close()
        Image.open(temporary).convert("RGB").quantize(128).save(temporary, format="PNG", optimize=True)


if __name__ == "__main__":
    main(tyro.cli(Arguments))

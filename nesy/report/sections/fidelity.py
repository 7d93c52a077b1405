"""How far the extracted 2DBN can be trusted."""

from __future__ import annotations

from typing import Any

from nesy.report import figures
from nesy.report.html_pieces import figure, table
from nesy.run_folder import RunFolder

ANCHOR = "fidelity"
TITLE = "Fidelity of the 2DBN"


def make(run: RunFolder, summary: dict[str, Any]) -> str:
    """The four panels, and every figure behind them; a run extracted before there was a report says so."""
    report = summary["dbn"].get("fidelity")
    if report is None:
        return (
            f"<p>This run has no fidelity report; make one with <code>nesy extract --run {run.path} --redo</code></p>"
        )
    from nesy.dbn.reading.fidelity_drawing import fidelity_figure

    picture = figure(
        figures.svg(fidelity_figure(report)),
        "Steps of new episodes under table, network and the empirical limit; factored rollouts against exact ones; "
        "plans along most probable outcomes, executed on the real map; steps that no map allows.",
        "Fidelity of the 2DBN in four panels",
    )
    return picture + _rows(summary["dbn"], report) + _rollouts(report["rollouts"])


def _rows(dbn: dict[str, Any], report: dict[str, Any]) -> str:
    held_out, structure = report["held_out"], report["structure"]
    rows = [
        ("largest difference of a table entry to the network", f"{dbn['max_difference_to_network']:.3g}"),
        ("rows against frequencies in the data, weighted by visits: total variation", f"{dbn['row_tv']:.4f}"),
        ("... KL divergence, nats", f"{dbn['row_kl']:.4f}"),
        ("... total variation on new episodes", f"{held_out['row_tv']:.4f}"),
        ("... KL divergence on new episodes, nats", f"{held_out['row_kl']:.4f}"),
        ("steps of new episodes that the table holds impossible", f"{held_out['impossible']:.2%}"),
        (f"parents of {structure['models']} synthetic models: precision", f"{structure['precision']:.3f}"),
        ("... recall", f"{structure['recall']:.3f}"),
    ]
    return table(("figure", "value"), rows, "How near the table is to network and data")


def _rollouts(rollouts: dict[str, Any]) -> str:
    def span(low: float, high: float) -> str:
        return f"{low:.3f}" if high - low < 0.0005 else f"{low:.3f} to {high:.3f}"

    rows = [
        (
            str(step),
            span(rollouts["joint_low"][i], rollouts["joint_high"][i]),
            span(rollouts["marginal_low"][i], rollouts["marginal_high"][i]),
            f"{rollouts['left_out'][i]:.4f}",
        )
        for i, step in enumerate(rollouts["steps"])
    ]
    caption = (
        "Total variation between product-of-marginals rollouts and exact ones; branches cut on the way leave the span "
        "open. Rollouts of marginals drift and are never to be read as exact."
    )
    return table(("steps", "whole codes", "single factors", "left out"), rows, caption)

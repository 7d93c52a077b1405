"""Environment steps, beside Minigrid's SimpleCrossingS9N1."""

from __future__ import annotations

from nesy.cli.benches.measuring import Row, Settings

NEEDS: tuple[str, ...] = ()


def measure(settings: Settings) -> list[Row]:
    """Steps per second by size, batch and player; then what a fresh process needs, beside the limits for it."""
    from domains.person_following.speed import benchmark, starts

    rows = benchmark(seconds=settings.seconds, seed=settings.seed)
    speeds = [
        Row(
            what=f"{row['what']}, size {row['size']}, {row['num_crossings']} crossings, batch {row['batch']}, "
            f"{row['player']} play",
            figure=row["steps_per_second"],
            unit="steps/s",
            peer=rows[0]["what"],
            ratio=row["minigrid_ratio"],
        )
        for row in rows
    ]
    needs = [
        Row(
            row["what"],
            row["figure"],
            row["unit"],
            f"limit {row['limit']:g} {row['unit']}",
            row["limit"] / row["figure"],
        )
        for row in starts()
    ]
    return speeds + needs

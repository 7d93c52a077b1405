"""Environment steps, beside Minigrid's SimpleCrossingS9N1."""

from __future__ import annotations

from nesy.cli.benches.measuring import Row, Settings

NEEDS: tuple[str, ...] = ()


def measure(settings: Settings) -> list[Row]:
    """Steps per second by size, batch and player."""
    from domains.person_following.speed import benchmark

    rows = benchmark(seconds=settings.seconds, seed=settings.seed)
    return [
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

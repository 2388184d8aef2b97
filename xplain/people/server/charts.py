"""Charts of the researcher's page as inline SVG: attributes only, no styles, no scripts."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

WIDTH, HEIGHT = 640, 150


def over_time(times: Sequence[float]) -> str:
    """How many there were until each time (seconds since 1970, in order), as a line; "" for fewer
    than two."""
    if len(times) < 2:
        return ""
    first, span = times[0], max(times[-1] - times[0], 1.0)
    corners = [
        f"{WIDTH * (at - first) / span:.1f},{HEIGHT * (1 - count / len(times)):.1f}"
        for count, at in enumerate(times, 1)
    ]
    began, ended = (f"{datetime.fromtimestamp(at, UTC):%d %b %H:%M}" for at in (first, times[-1]))
    said = f"{len(times)} answers from {began} to {ended} UTC"
    return (
        f'<svg class="chart" viewBox="-6 -16 {WIDTH + 12} {HEIGHT + 40}" role="img" '
        f'aria-label="{said}"><path d="M0 {HEIGHT}H{WIDTH}" stroke="currentColor"/>'
        f'<polyline points="{" ".join(corners)}" fill="none" stroke="#2F7EC8" stroke-width="3"/>'
        f'<g fill="currentColor" font-size="13"><text x="0" y="{HEIGHT + 18}">{began}</text>'
        f'<text x="{WIDTH}" y="{HEIGHT + 18}" text-anchor="end">{ended} UTC</text>'
        f'<text x="{WIDTH}" y="-4" text-anchor="end">{len(times)} answers</text></g></svg>'
    )

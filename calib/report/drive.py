"""A route to a drawing of it: the approaches that are still to be driven, from above."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from polecal.calib.report.figures import BLUE, INK, ORANGE, PALE, Drawing, drawn, styled
from polecal.calib.route import Leg

_ARROW = 0.35  # of a leg, where its arrow is


@styled
def route(legs: Sequence[Leg]) -> Drawing:
    """Draw legs about the pole, north up: what is driven forward, what in reverse, and the turns."""
    figure = Figure(figsize=(5.6, 5.6), layout="constrained")
    axes = figure.add_subplot()
    for leg in legs:
        north, east = leg.points[:, 0], leg.points[:, 1]
        if leg.kind == "turn":
            axes.plot(east, north, color=PALE, lw=0.8, zorder=1)
            continue
        reverse = leg.direction == "reverse"
        colour, style = (ORANGE, (0, (2, 1.5))) if reverse else (BLUE, "solid")
        axes.plot(east, north, color=colour, ls=style, lw=1.8, zorder=3 if reverse else 2)
        at = max(1, int(_ARROW * len(north)))
        tip, tail = (east[at], north[at]), (east[at - 1], north[at - 1])
        axes.annotate("", tip, tail, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2}, zorder=4)
    axes.plot(0, 0, "o", color=INK, ms=5, zorder=5)
    axes.set(xlabel="east of the pole, m", ylabel="north of the pole, m", aspect="equal")
    axes.grid()
    passes = [leg for leg in legs if leg.kind == "pass"]
    backwards = sum(leg.direction == "reverse" for leg in passes)
    key = [Line2D([], [], color=BLUE, label="past the pole")]
    if backwards:
        key.append(Line2D([], [], color=ORANGE, ls=(0, (2, 1.5)), label="back in reverse"))
    key.append(Line2D([], [], color=PALE, lw=0.8, label="turn"))
    figure.legend(handles=key, loc="outside upper center", ncols=len(key))
    slices = sorted({leg.slice for leg in passes if leg.slice is not None})
    return drawn(
        figure,
        "route",
        "Still to be driven",
        "Approaches that fill what is missing, from above, and turns between them; polecal-field route gives "
        "them as GeoJSON, GPX or CSV.",
        f"A route of {len(passes)} approaches, {backwards} of them in reverse, in slices "
        f"{', '.join(map(str, slices))}.",
    )

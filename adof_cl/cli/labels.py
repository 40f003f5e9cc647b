"""Names beside points of a plot, none over another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GAP = 3.0  # points between a name and its point
_STEP = 0.9  # of a line's height, from one try to the next
_TRIES = 14


def label_points(
    axes: Axes, points: Sequence[tuple[float, float]], names: Sequence[str], size: float = 6.5
) -> None:
    """Write each point's name as near to it as there is room, with a thin line where that is not beside it.

    Call it once limits and scales are final and the figure was drawn.
    """
    scale = axes.figure.dpi / 72.0
    line = 1.2 * size * scale
    frame = axes.get_window_extent()
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    taken = [(x - 3, y - 3, x + 3, y + 3) for x, y in pixels]
    for (x, y), point, name in sorted(zip(pixels, points, names, strict=True)):
        written = axes.text(0.0, 0.0, name, fontsize=size)
        width = written.get_window_extent().width
        written.remove()
        best = None
        for number in range(_TRIES):
            for up in (1, -1):
                for left in (x + _GAP * scale, x - width - _GAP * scale, x - width / 2):
                    away = 2 * scale + number * _STEP * line
                    low = y + away if up > 0 else y - away - line
                    box = (left, low, left + width, low + line)
                    inside = box[0] >= frame.x0 and box[2] <= frame.x1
                    inside = inside and box[1] >= frame.y0 and box[3] <= frame.y1
                    if inside and not any(_overlap(box, other) for other in taken):
                        best = box
                        break
                if best:
                    break
            if best:
                break
        if best is None:
            continue  # no room anywhere near: the table has it
        taken.append(best)
        at = ((best[0] - x) / scale, (best[1] - y) / scale)
        far = abs((best[1] + best[3]) / 2 - y) > 1.2 * line
        axes.annotate(
            name, point, xytext=at, textcoords="offset points",
            fontsize=size, arrowprops={"arrowstyle": "-", "linewidth": 0.3, "shrinkB": 2} if far else None,
        )  # fmt: skip


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
